"""Trajectories in segments: motions within one, turn rates of all, and the start from them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from calgraph.drive.segments import Segments
from calgraph.drive.start import MotionStart, solve_start
from calgraph.geometry import Array, se_n
from calgraph.surfaces.trajectory import Track

TIMES: Array = np.arange(600) / 10
T_ROOT_SENSOR = se_n.pose(se_n.exp(np.array([0.5, -1.0, 2.0])), np.array([0.4, -0.3, 0.7]))
T_ROOT_SENSOR.setflags(write=False)


def path(times: Array) -> Array:
    """A smooth path in space that turns about all axes."""
    place = np.stack([3 * np.sin(0.2 * times), 2 * np.sin(0.31 * times), 0.3 * np.sin(0.5 * times)], axis=1)
    heading = 0.4 * times + 0.9 * np.sin(0.6 * times) + 0.2 * np.sin(1.7 * times)
    turn = np.stack([0.3 * np.sin(0.8 * times), 0.3 * np.sin(0.5 * times + 1), heading], axis=1)
    return se_n.pose(Rotation.from_euler("xyz", turn).as_matrix(), place)


def in_segments(times: Array, poses: Array, *bounds: tuple[float, float]) -> Segments:
    """The poses within intervals of time, each from its own first pose."""
    tracks = []
    for start, end in bounds:
        some = (times >= start) & (times < end)
        tracks.append(Track(times[some], se_n.inverse(poses[some][0]) @ poses[some]))
    return Segments(tracks)


def test_motions_are_known_within_a_segment_only() -> None:
    segments = in_segments(TIMES, path(TIMES), (0, 20), (22, 60))
    starts = np.array([-0.1, 0.0, 18.4, 18.5, 19.0, 21.0, 22.0, 58.5])
    motions, known = segments.relative(starts, 1.5)
    assert known.tolist() == [False, True, True, False, False, False, True, False]
    expected = se_n.inverse(path(starts)) @ path(starts + 1.5)
    assert_allclose(motions[known], expected[known], atol=1e-3)


def test_turn_rates_are_unknown_in_a_long_gap_only() -> None:
    times = np.array([10.0, 20.5, 21.0, 30.15])
    _, known = in_segments(TIMES, path(TIMES), (0, 20), (22, 30), (30.3, 60)).turn_rates(times)
    assert known.tolist() == [True, False, False, True]


@pytest.mark.parametrize("offset", [-0.21, 0.137])
def test_a_sensor_whose_worlds_differ_between_segments_has_a_start(offset: float) -> None:
    """A camera that sees three boards with gaps of seconds, and a root that lost its place once."""
    root = in_segments(TIMES, path(TIMES), (0, 33), (33.5, 60))
    poses = path(TIMES + 0.03) @ T_ROOT_SENSOR
    sensor = in_segments(TIMES + 0.03 + offset, poses, (2, 14), (17, 30), (36, 58))
    start = solve_start(root, sensor, 0.5, np.random.default_rng(0))
    assert isinstance(start, MotionStart)
    assert start.clock_offset == pytest.approx(offset, abs=0.003)
    assert start.inliers == 1
    # Interpolated between poses of 10 Hz.
    assert_allclose(se_n.difference(start.T_root_sensor, T_ROOT_SENSOR), 0, atol=0.02)
