"""Pairs of sensors around boards with known poses: detections made from the truth, with noise and outliers."""

import numpy as np
import pytest

from calgraph.detection import PlanePatch, Rejected, Segment
from calgraph.geometry import plane, se3, so3
from calgraph.pairwise import coplanarity, estimate_pair

SIZE = (1.2, 0.9)


def random_pose(rng, translation=0.3, rotation=3.0):
    axis = rng.normal(size=3)
    return se3.pose(
        so3.exp(axis / np.linalg.norm(axis) * rng.uniform(0, rotation)), rng.normal(size=3) * translation
    )


def boards(rng, count, tilt=0.6):
    """Boards 1.5–3 m away all around frame a, facing it, turned by up to ``tilt`` about each axis."""
    poses = []
    for _ in range(count):
        bearing, radius = rng.uniform(-np.pi, np.pi), rng.uniform(1.5, 3.0)
        outward = np.array([np.cos(bearing), np.sin(bearing), 0])
        facing = np.stack([np.cross([0, 0, 1.0], -outward), [0, 0, 1.0], -outward], axis=1)
        poses.append(
            se3.pose(
                so3.exp(rng.uniform(-tilt, tilt, 3)) @ facing, radius * outward + [0, 0, rng.uniform(-0.2, 0.2)]
            )
        )
    return np.array(poses)


def patch(T_s_board, rng, sigma=0.003):
    seen = plane.towards_origin(plane.from_pose(T_s_board))
    # Turned and shifted about the board's centre, as a fit to points on the board is.
    about_center = np.eye(3)
    about_center[2, :2] = -T_s_board[:3, 3] @ plane.tangent_basis(seen[:3])
    root = about_center * [sigma / 0.3, sigma / 0.3, sigma]
    noisy = plane.retract(seen, root @ rng.normal(size=3))
    return PlanePatch(noisy, root @ root.T, np.empty((0, 3)), T_s_board[:3, 3])


def segment(T_s_board, rng, sigma=0.003):
    """The cut of the board with z = 0; None if the scan plane misses it."""
    corners = se3.apply(
        T_s_board, np.array([[x, y, 0] for x, y in ((-0.6, -0.45), (0.6, -0.45), (0.6, 0.45), (-0.6, 0.45))])
    )
    cuts = [
        p + (q - p) * p[2] / (p[2] - q[2])
        for p, q in zip(corners, np.roll(corners, -1, axis=0), strict=True)
        if p[2] * q[2] < 0
    ]
    if len(cuts) != 2 or np.linalg.norm(cuts[0] - cuts[1]) < 0.2:
        return None
    ends = np.array(cuts)
    ends[:, :2] += rng.normal(size=(2, 2)) * sigma
    return Segment(ends, np.diag([sigma**2, sigma**2, 1e-8] * 2), ends)


def observe(kind, T_s_root, boards_root, rng):
    see = patch if kind == "plane" else segment
    seen = {i: see(T_s_root @ T, rng) for i, T in enumerate(boards_root)}
    return {i: (d,) for i, d in seen.items() if d is not None}


def error(T_est, T):
    d = se3.difference(T_est, T)
    return np.linalg.norm(d[:3]), np.degrees(np.linalg.norm(d[3:]))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("kind_a", "kind_b", "metres", "degrees"),
    [("plane", "plane", 0.02, 0.5), ("plane", "line", 0.01, 0.4), ("line", "plane", 0.01, 0.4)],
)
def test_pair_is_found_among_disturbed_captures(kind_a, kind_b, metres, degrees, seed):
    rng = np.random.default_rng(seed)
    scene = boards(rng, 60)
    moved = scene.copy()
    for i in rng.choice(60, 8, replace=False):
        moved[i] = se3.retract(moved[i], rng.normal(size=6) * 0.3)
    # Scanners that see each other's board are mounted with some tilt, at different places.
    T_a_b = random_pose(rng, rotation=3.0 if kind_a == kind_b else 0.6)
    a = observe(kind_a, np.eye(4), scene, rng)
    b = observe(kind_b, se3.inverse(T_a_b), moved, rng)
    found = estimate_pair("a", "b", a, b, SIZE, rng)
    assert not isinstance(found, Rejected), found
    assert error(found.T_a_b, T_a_b) < (metres, degrees)


@pytest.mark.parametrize("seed", range(5))
def test_two_line_scanners_explain_new_boards(seed):
    """Coplanarity leaves the turn about the scan planes' common line open; all else must hold for new boards."""
    rng = np.random.default_rng(seed)
    T_a_b = se3.pose(so3.exp(np.array([0.5, 0.3, 0.4])), np.array([0.3, -0.2, 0.1]))
    scene = boards(rng, 60)
    moved = scene.copy()
    for i in rng.choice(60, 8, replace=False):
        moved[i] = se3.retract(moved[i], rng.normal(size=6) * 0.3)
    found = estimate_pair(
        "a",
        "b",
        observe("line", np.eye(4), scene, rng),
        observe("line", se3.inverse(T_a_b), moved, rng),
        SIZE,
        rng,
    )
    assert not isinstance(found, Rejected), found
    new = boards(rng, 40)
    a, b = observe("line", np.eye(4), new, rng), observe("line", se3.inverse(T_a_b), new, rng)
    gaps = [coplanarity(found.T_a_b, a[i][0].endpoints, b[i][0].endpoints)[0] for i in set(a) & set(b)]
    assert np.sqrt(np.mean(np.square(gaps))) < 0.015
    spread = np.linalg.eigvalsh(found.information)
    assert spread[0] < 1e-3 * spread[1]


def test_the_right_one_of_several_candidates_is_picked(rng):
    scene = boards(rng, 30)
    T_a_b = random_pose(rng)
    a = observe("plane", np.eye(4), scene, rng)
    b = {
        i: (patch(se3.inverse(T_a_b) @ boards(rng, 1)[0], rng), *seen)
        for i, seen in observe("plane", se3.inverse(T_a_b), scene, rng).items()
    }
    found = estimate_pair("a", "b", a, b, SIZE, rng)
    assert not isinstance(found, Rejected)
    chosen = found.matches[found.inliers]
    assert (chosen[:, 2] == 1).mean() > 0.95


def test_too_few_common_captures_are_said(rng):
    scene = boards(rng, 2)
    seen = observe("plane", np.eye(4), scene, rng)
    found = estimate_pair("a", "b", seen, seen, SIZE, rng)
    assert isinstance(found, Rejected)
    assert "2 captures" in found.reason


def test_upright_boards_leave_height_roll_and_pitch_open(rng):
    """Upright boards in an upright scanner's plane: only x, y and yaw can be known, and those are right."""
    scene = boards(rng, 12, tilt=0.0)
    for i in range(12):
        scene[i, :3, :3] = so3.exp(np.array([0, 0, rng.uniform(-0.6, 0.6)])) @ scene[i, :3, :3]
    T_a_b = se3.pose(so3.exp(np.array([0, 0, 0.3])), np.array([0.2, -0.1, 0.0]))
    a = observe("plane", np.eye(4), scene, rng)
    b = observe("line", se3.inverse(T_a_b), scene, rng)
    found = estimate_pair("a", "b", a, b, SIZE, rng)
    assert not isinstance(found, Rejected)
    known = [0, 1, 5]
    assert np.abs(se3.difference(found.T_a_b, T_a_b)[known]).max() < 0.01
    spread = 1 / np.sqrt(np.maximum(np.diag(found.information), 1e-9))
    assert spread[known].max() < 0.01
    assert spread[[2, 3, 4]].min() > 0.05
