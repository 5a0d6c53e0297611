"""Poses of two 2-D scanners by linear algebra, from lines on boards with given poses."""

import numpy as np
import pytest

from board_scenes import detect_boards, make_boards, random_pose, segment_endpoints
from calgraph.geometry import Array, se3, so3
from calgraph.rig.pairs.line_matches import _intersect_lines, evaluate_coplanarity, solve_coplanar_lines

DIHEDRAL = 0.15  # rad, between the scan planes of the solutions


def segments(T_a_b: Array, rng: np.random.Generator, count: int = 40, sigma: float = 1e-9) -> Array:
    scene = make_boards(rng, count)
    a, b = (
        detect_boards("line", np.eye(4), scene, rng, sigma),
        detect_boards("line", se3.inverse(T_a_b), scene, rng, sigma),
    )
    common = sorted(set(a) & set(b))
    return np.array([[segment_endpoints(detections, i) for i in common] for detections in (a, b)])[:, None]


@pytest.mark.parametrize("seed", range(5))
def test_all_lines_are_coplanar_under_the_pose_of_any_mounting(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = segments(random_pose(rng), rng)
    gaps = evaluate_coplanarity(solve_coplanar_lines(a, b, DIHEDRAL)[:, None], a, b)[0]
    np.testing.assert_allclose(gaps, 0, atol=1e-6)


def test_only_the_dihedral_angle_differs_from_the_truth(rng: np.random.Generator) -> None:
    """The scan planes of scanners rotated about x by 0.5 intersect in the x axis."""
    T_a_b = se3.pose(so3.exp(np.array([0.5, 0, 0])), np.array([0.3, 0, 0]))
    a, b = segments(T_a_b, rng)
    difference = se3.difference(solve_coplanar_lines(a, b, DIHEDRAL)[0], T_a_b)
    np.testing.assert_allclose(difference[[0, 1, 2, 4, 5]], 0, atol=1e-6)


def test_samples_are_solved_independently(rng: np.random.Generator) -> None:
    several = [segments(random_pose(rng), rng)[:, :, :8] for _ in range(6)]
    pairs = [pair for pair in several if pair.shape[2] == 8]
    together = solve_coplanar_lines(
        np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs]), DIHEDRAL
    )
    np.testing.assert_allclose(
        together, np.concatenate([solve_coplanar_lines(a, b, DIHEDRAL) for a, b in pairs]), atol=1e-9
    )


@pytest.mark.parametrize("roll", [-2.6, -0.5, 0.5, 2.6])
@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_segments_of_a_board_are_near_each_other(roll: float, yaw: float, rng: np.random.Generator) -> None:
    """Of the two possible dihedral angles, the one with all boards on one side of the intersection."""
    R = so3.exp(np.array([roll, 0, 0])) @ so3.exp(np.array([0, 0, yaw]))
    a, b = segments(se3.pose(R, np.array([0.3, 0.2, 0.1])), rng)
    T = solve_coplanar_lines(a, b, DIHEDRAL)
    apart = np.linalg.norm(se3.apply(T, b.mean(axis=2)) - a.mean(axis=2), axis=-1)
    assert np.median(apart) < 0.6


def test_a_line_parallel_to_the_axis_has_no_weight() -> None:
    """Weights are squared sines: that of a line of 90° is 1."""
    axis = np.array([[1.0, 0.0, 0.0]])
    lines = np.array([[[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]]])
    crossing, sine = _intersect_lines(lines, axis)
    assert np.isfinite(crossing).all()
    np.testing.assert_allclose(sine**2, [[0, 1]], atol=1e-11)
