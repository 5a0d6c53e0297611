"""Pairs of sensors around boards with given poses: detections from the ground truth, with noise and outliers."""

import numpy as np
import pytest

from board_scenes import SIZE, detect_boards, make_boards, make_patch, random_pose, segment_endpoints
from calgraph.boards.detections import PlanePatch
from calgraph.config.settings import BoardPairSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3, so3
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.rig.pairs.board_matches import Disagreement
from calgraph.rig.pairs.board_pair import estimate_pair, estimate_pairs
from calgraph.rig.pairs.line_matches import evaluate_coplanarity


def error(T_est: Array, T: Array) -> tuple[float, float]:
    d = se3.difference(T_est, T)
    return float(np.linalg.norm(d[:3])), float(np.degrees(np.linalg.norm(d[3:])))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("kind_a", "kind_b", "metres", "degrees"),
    [("plane", "plane", 0.02, 0.5), ("plane", "line", 0.01, 0.4), ("line", "plane", 0.01, 0.4)],
)
def test_pair_is_found_among_disturbed_captures(
    kind_a: str, kind_b: str, metres: float, degrees: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    scene = make_boards(rng, 60)
    moved = scene.copy()
    for i in rng.choice(60, 8, replace=False):
        moved[i] = se3.retract(moved[i], rng.normal(size=6) * 0.3)
    # Scanners that see each other's board are mounted with some tilt, at different places.
    T_a_b = random_pose(rng, rotation=3.0 if kind_a == kind_b else 0.6)
    a = detect_boards(kind_a, np.eye(4), scene, rng)
    b = detect_boards(kind_b, se3.inverse(T_a_b), moved, rng)
    found = estimate_pair("a", "b", a, b, SIZE, rng, settings=BoardPairSettings())
    assert not isinstance(found, Rejected), found
    assert error(found.T_a_b, T_a_b) < (metres, degrees)


@pytest.mark.parametrize("seed", range(5))
def test_two_line_scanners_predict_new_boards(seed: int) -> None:
    """All directions but the rotation about the intersection of the scan planes are tested on new boards."""
    rng = np.random.default_rng(seed)
    T_a_b = se3.pose(so3.exp(np.array([0.5, 0.3, 0.4])), np.array([0.3, -0.2, 0.1]))
    scene = make_boards(rng, 60)
    moved = scene.copy()
    for i in rng.choice(60, 8, replace=False):
        moved[i] = se3.retract(moved[i], rng.normal(size=6) * 0.3)
    found = estimate_pair(
        "a",
        "b",
        detect_boards("line", np.eye(4), scene, rng),
        detect_boards("line", se3.inverse(T_a_b), moved, rng),
        SIZE,
        rng,
        settings=BoardPairSettings(),
    )
    assert not isinstance(found, Rejected), found
    new = make_boards(rng, 40)
    a, b = (
        detect_boards("line", np.eye(4), new, rng, 1e-9),
        detect_boards("line", se3.inverse(T_a_b), new, rng, 1e-9),
    )
    gaps = [
        evaluate_coplanarity(found.T_a_b, segment_endpoints(a, i), segment_endpoints(b, i))[0]
        for i in set(a) & set(b)
    ]
    assert np.sqrt(np.mean(np.square(gaps))) < 0.015
    spread = np.linalg.eigvalsh(found.information)
    assert spread[0] < 1e-3 * spread[1]


def test_the_correct_one_of_several_candidates_is_selected(rng: np.random.Generator) -> None:
    scene = make_boards(rng, 30)
    T_a_b = random_pose(rng)
    a = detect_boards("plane", np.eye(4), scene, rng)
    b = {
        i: (make_patch(se3.inverse(T_a_b) @ make_boards(rng, 1)[0], rng), *found)
        for i, found in detect_boards("plane", se3.inverse(T_a_b), scene, rng).items()
    }
    found = estimate_pair("a", "b", a, b, SIZE, rng, settings=BoardPairSettings())
    assert not isinstance(found, Rejected)
    chosen = found.matches[found.inliers]
    assert (chosen[:, 2] == 1).mean() > 0.95


@pytest.mark.parametrize("board_first", [True, False])
@pytest.mark.parametrize("captures", [8, 11, 12])
def test_every_seed_finds_all_boards_among_eight_candidates_of_a_lidar(captures: int, board_first: bool) -> None:
    """Without a background, seven surfaces of the room are candidates in every capture.

    One in 512 samples consists of boards: with 2000 samples, one seed in 50 drew none, for all rigs with the same
    number of captures.
    """
    rng = np.random.default_rng(2)
    scene, T_a_b = make_boards(rng, captures), random_pose(rng)
    room = tuple(make_patch(se3.inverse(T_a_b) @ T, rng) for T in make_boards(rng, 7))
    a = detect_boards("plane", np.eye(4), scene, rng)
    boards = detect_boards("plane", se3.inverse(T_a_b), scene, rng)
    b = {i: (*found, *room) if board_first else (*room, *found) for i, found in boards.items()}
    for seed in range(2):
        found = estimate_pair("a", "b", a, b, SIZE, np.random.default_rng(seed), settings=BoardPairSettings())
        assert not isinstance(found, Rejected), found
        chosen = found.matches[found.inliers]
        assert chosen[:, 0].tolist() == list(range(captures))
        assert (chosen[:, 2] == (0 if board_first else 7)).all()


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_shared_captures_are_rejected(count: int, rng: np.random.Generator) -> None:
    scene = make_boards(rng, count)
    detections = detect_boards("plane", np.eye(4), scene, rng)
    found = estimate_pair("a", "b", detections, detections, SIZE, rng, settings=BoardPairSettings())
    assert found == Rejected(f"both detected the board in {count} captures, 3 are needed")


@pytest.mark.parametrize(("sigmas", "inlier"), [(2.8, True), (3.2, False)])
def test_captures_are_inliers_up_to_three_standard_deviations(
    sigmas: float, inlier: bool, rng: np.random.Generator
) -> None:
    """Of the model error of 10 mm: one of twelve exact boards is displaced along its normal."""
    scene = make_boards(rng, 12)
    moved = scene.copy()
    moved[4, :3, 3] += sigmas * 0.01 * moved[4, :3, 2]
    a, b = (detect_boards("plane", np.eye(4), boards, rng, 1e-6) for boards in (scene, moved))
    found = estimate_pair("a", "b", a, b, SIZE, rng, refine=False, settings=BoardPairSettings())
    assert not isinstance(found, Rejected)
    assert found.inliers[found.matches[:, 0] == 4].tolist() == [inlier]


def test_upright_boards_leave_height_roll_and_pitch_unobservable(rng: np.random.Generator) -> None:
    """Upright boards in an upright scanner's plane: only x, y and yaw are observable."""
    scene = make_boards(rng, 12, tilt=0.0)
    for i in range(12):
        scene[i, :3, :3] = so3.exp(np.array([0, 0, rng.uniform(-0.6, 0.6)])) @ scene[i, :3, :3]
    T_a_b = se3.pose(so3.exp(np.array([0, 0, 0.3])), np.array([0.2, -0.1, 0.0]))
    a = detect_boards("plane", np.eye(4), scene, rng)
    b = detect_boards("line", se3.inverse(T_a_b), scene, rng)
    found = estimate_pair("a", "b", a, b, SIZE, rng, settings=BoardPairSettings())
    assert not isinstance(found, Rejected)
    observable = [0, 1, 5]
    assert np.abs(se3.difference(found.T_a_b, T_a_b)[observable]).max() < 0.01
    spread = 1 / np.sqrt(np.maximum(np.diag(found.information), 1e-9))
    assert spread[observable].max() < 0.01
    assert spread[[2, 3, 4]].min() > 0.05


def test_refinement_on_the_inliers_fits_them_better(rng: np.random.Generator) -> None:
    scene, T_a_b = make_boards(rng, 40), random_pose(rng)
    a, b = (detect_boards("plane", T, scene, rng) for T in (np.eye(4), se3.inverse(T_a_b)))
    refined, minimal = (
        estimate_pair("a", "b", a, b, SIZE, np.random.default_rng(1), refine=refine, settings=BoardPairSettings())
        for refine in (True, False)
    )
    assert isinstance(refined, PairwiseEstimate)
    assert isinstance(minimal, PairwiseEstimate)
    assert refined.normalized_rms < 0.97 * minimal.normalized_rms
    assert error(refined.T_a_b, T_a_b) < (0.005, 0.1)


@pytest.mark.parametrize(("kind", "count", "inliers"), [("plane", 3, 3), ("line", 9, 8)])
def test_pairs_need_more_residuals_than_unknowns(
    kind: str, count: int, inliers: int, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calgraph.rig.pairs.board_pair._MINORITY_INLIERS", 0)
    a, b = (detect_boards(kind, np.eye(4), make_boards(rng, 40), rng) for _ in range(2))
    common = sorted(set(a) & set(b))[:count]
    found = estimate_pair(
        "a", "b", {i: a[i] for i in common}, {i: b[i] for i in common}, SIZE, rng, settings=BoardPairSettings()
    )
    assert isinstance(found, Rejected)
    assert found.reason.startswith(
        f"RANSAC found no relative pose with at least {inliers} inliers among {count} shared captures: "
    )


@pytest.mark.parametrize(("consistent", "captures", "accepted"), [(4, 12, False), (5, 12, True), (4, 8, True)])
def test_a_pose_of_a_minority_of_captures_needs_more_inliers(
    consistent: int, captures: int, accepted: bool, rng: np.random.Generator
) -> None:
    scene, T_a_b = make_boards(rng, captures), random_pose(rng)
    elsewhere = make_boards(rng, captures)
    elsewhere[:consistent] = scene[:consistent]
    a = detect_boards("plane", np.eye(4), scene, rng)
    b = detect_boards("plane", se3.inverse(T_a_b), elsewhere, rng)
    found = estimate_pair("a", "b", a, b, SIZE, rng, settings=BoardPairSettings())
    if accepted:
        assert isinstance(found, PairwiseEstimate), found
        assert found.matches[found.inliers, 0].tolist() == list(range(consistent))
    else:
        assert found == Disagreement(
            "RANSAC found no relative pose with at least 5 inliers among 12 shared captures: 4 agree at most", 4
        )


def test_a_rejected_pair_states_the_number_of_candidates(rng: np.random.Generator) -> None:
    a, b = (detect_boards("plane", np.eye(4), make_boards(rng, 12), rng) for _ in range(2))
    b = {i: (*found, make_patch(make_boards(rng, 1)[0], rng)) for i, found in b.items()}
    found = estimate_pair("a", "b", a, b, SIZE, rng, settings=BoardPairSettings())
    assert isinstance(found, Rejected)
    assert "among 12 shared captures, with up to 2 candidates for the board in one: " in found.reason


def test_residuals_are_rms_distances_of_the_two_planes(rng: np.random.Generator) -> None:
    # A translation by d moves a plane by n d.
    a = detect_boards("plane", np.eye(4), make_boards(rng, 30), rng, 1e-9)
    d = np.array([0.02, -0.01, 0.005])
    known = se3.pose(np.eye(3), d)
    found = estimate_pair("a", "b", a, a, SIZE, rng, settings=BoardPairSettings(), known=known)
    assert isinstance(found, PairwiseEstimate)
    normals = np.array([one.plane[:3] for (one,) in a.values() if isinstance(one, PlanePatch)])
    np.testing.assert_allclose(found.residuals, np.abs(normals @ d), atol=1e-6)


@pytest.mark.parametrize(("refine", "degrees"), [(True, 40.0), (False, 0.0)])
def test_upright_boards_leave_the_side_ambiguous_to_which_a_scanner_is_tilted(
    refine: bool, degrees: float
) -> None:
    """By 20° about x; a pose tilted to the other side fits equally well; it is searched if poses are refined."""
    rng = np.random.default_rng(0)
    scene = make_boards(rng, 30, tilt=0.0)
    for i in range(30):
        scene[i, :3, :3] = so3.exp(np.array([0, 0, rng.uniform(-0.6, 0.6)])) @ scene[i, :3, :3]
    T_a_b = se3.pose(so3.exp(np.array([np.radians(20), 0, 0])), np.array([0.2, -0.1, 0.0]))
    a = detect_boards("plane", np.eye(4), scene, rng)
    b = detect_boards("line", se3.inverse(T_a_b), scene, rng)
    found = estimate_pair(
        "a", "b", a, b, SIZE, np.random.default_rng(1), refine=refine, settings=BoardPairSettings()
    )
    assert isinstance(found, PairwiseEstimate)
    assert np.degrees(found.alternative_pose_angle) == pytest.approx(degrees, abs=1.0)


def test_progress_is_the_share_of_pairs_that_are_done(rng: np.random.Generator) -> None:
    detections = {name: detect_boards("plane", np.eye(4), make_boards(rng, 3), rng) for name in "abc"}
    shares: list[float] = []
    assert len(estimate_pairs(detections, SIZE, rng, shares.append, settings=BoardPairSettings())) == 3
    assert shares == pytest.approx([1 / 3, 2 / 3, 1.0])
