"""Registration of windows of scans to a reference."""

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.network.tracking.background_registration import ReferenceScan, WindowPoses, register_windows
from static_rooms import ANGLES, CORRIDOR, scan_room, step

NOISE = 0.003


def register(poses: Array) -> WindowPoses:
    """Registers scans at poses (W, 3), x, y, m, and angle, degrees, to one at the origin."""
    ranges = [scan_room(0.1, step(0.0, *pose), noise=NOISE)[0].ranges for pose in poses]
    reference = ReferenceScan(ANGLES, scan_room(0.2, noise=NOISE)[1].ranges)
    return register_windows(reference, np.array(ranges), NOISE)


@pytest.mark.parametrize("degrees", [0.0, 0.5, 3.0, -20.0, 120.0])
def test_the_pose_is_found(degrees: float) -> None:
    true = np.array([[0.0, 0.0, degrees], [0.05, -0.03, degrees]])
    found = register(true)
    assert np.abs(found.poses[:, :2] - true[:, :2]).max() < 0.004
    assert np.abs(found.poses[:, 2] - np.radians(true[:, 2])).max() < 1e-3


def test_nearly_all_points_agree_at_the_right_pose() -> None:
    assert register(np.array([[0.02, 0.0, 2.0]])).agreement[0] > 0.95


def test_covariance_contains_the_error(rng: np.random.Generator) -> None:
    true = np.column_stack([rng.uniform(-0.02, 0.02, (60, 2)), rng.uniform(-1, 1, 60)])
    error = register(true).poses - true * [1, 1, np.pi / 180]
    # All windows share the error of the reference.
    error -= error.mean(axis=0)
    information = register(true).information / NOISE**2
    assert np.mean(np.einsum("wi,wij,wj->w", error, information, error)) / 3 < 2.0


def test_a_corridor_has_no_information_along_it() -> None:
    reference = ReferenceScan(ANGLES, scan_room(0.1, segments=lambda _: CORRIDOR, noise=1e-4)[0].ranges)
    found = register_windows(reference, reference.ranges[None], 0.01)
    stddev = 0.01 * np.sqrt(np.diagonal(np.linalg.inv(found.information[0])))
    assert stddev[0] > 0.1
    assert stddev[1] < 0.005


def test_points_in_front_of_the_surfaces_are_not_compared() -> None:
    ranges = scan_room(0.1, noise=NOISE)[0].ranges.copy()
    ranges[:200] = 0.5
    reference = ReferenceScan(ANGLES, scan_room(0.2, noise=NOISE)[1].ranges)
    found = register_windows(reference, ranges[None], 0.01)
    assert found.agreement[0] > 0.95


def test_points_behind_the_surfaces_contradict() -> None:
    ranges = scan_room(0.1, noise=NOISE)[0].ranges.copy()
    ranges[:350] += 3.0
    reference = ReferenceScan(ANGLES, scan_room(0.2, noise=NOISE)[1].ranges)
    assert register_windows(reference, ranges[None], 0.01).agreement[0] < 0.6
