"""Pairs of sensors around boards with given poses: detections from the ground truth, with noise and outliers."""

import numpy as np
import pytest

from board_scenes import SIZE, detect_boards, make_boards, make_patch, random_pose, segment_endpoints
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3, so3
from calgraph.pairwise import estimate_pair, evaluate_coplanarity


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
    found = estimate_pair("a", "b", a, b, SIZE, rng)
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
    found = estimate_pair("a", "b", a, b, SIZE, rng)
    assert not isinstance(found, Rejected)
    chosen = found.matches[found.inliers]
    assert (chosen[:, 2] == 1).mean() > 0.95


def test_too_few_shared_captures_are_rejected(rng: np.random.Generator) -> None:
    scene = make_boards(rng, 2)
    detections = detect_boards("plane", np.eye(4), scene, rng)
    found = estimate_pair("a", "b", detections, detections, SIZE, rng)
    assert isinstance(found, Rejected)
    assert "2 captures" in found.reason


def test_upright_boards_leave_height_roll_and_pitch_unobservable(rng: np.random.Generator) -> None:
    """Upright boards in an upright scanner's plane: only x, y and yaw are observable."""
    scene = make_boards(rng, 12, tilt=0.0)
    for i in range(12):
        scene[i, :3, :3] = so3.exp(np.array([0, 0, rng.uniform(-0.6, 0.6)])) @ scene[i, :3, :3]
    T_a_b = se3.pose(so3.exp(np.array([0, 0, 0.3])), np.array([0.2, -0.1, 0.0]))
    a = detect_boards("plane", np.eye(4), scene, rng)
    b = detect_boards("line", se3.inverse(T_a_b), scene, rng)
    found = estimate_pair("a", "b", a, b, SIZE, rng)
    assert not isinstance(found, Rejected)
    observable = [0, 1, 5]
    assert np.abs(se3.difference(found.T_a_b, T_a_b)[observable]).max() < 0.01
    spread = 1 / np.sqrt(np.maximum(np.diag(found.information), 1e-9))
    assert spread[observable].max() < 0.01
    assert spread[[2, 3, 4]].min() > 0.05
