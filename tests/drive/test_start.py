"""Start values from trajectories of a root and a sensor, some with wrong motions, in the plane and in space."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from calgraph.drive.segments import Segments
from calgraph.drive.start import (
    MOTION_DURATION,
    MotionStart,
    _errors,
    _jacobian,
    _sample_poses,
    _scale,
    _solve_pose,
    explain_failure,
    find_clock_offset,
    solve_start,
)
from calgraph.geometry import Array, se_n
from calgraph.surfaces.trajectory import Track

DIMENSIONS = pytest.mark.parametrize("n", [2, 3])
OFFSET = 0.137


def path(times: Array, n: int) -> Array:
    """A smooth path of a robot, in space one that turns about all axes."""
    place = np.stack([3 * np.sin(0.2 * times), 2 * np.sin(0.31 * times), 0.3 * np.sin(0.5 * times)], axis=1)
    heading = 0.4 * times + 0.9 * np.sin(0.6 * times) + 0.2 * np.sin(1.7 * times)
    if n == 2:
        return se_n.pose(se_n.exp(heading[:, None]), place[:, :2])
    turn = np.stack([0.3 * np.sin(0.8 * times), 0.3 * np.sin(0.5 * times + 1), heading], axis=1)
    return se_n.pose(Rotation.from_euler("xyz", turn).as_matrix(), place)


def mounted(n: int) -> Array:
    """The sensor's pose on the root, far from none."""
    if n == 2:
        return se_n.pose(se_n.exp(np.array([-2.5])), np.array([0.4, -0.3]))
    return se_n.pose(se_n.exp(np.array([0.5, -1.0, 2.0])), np.array([0.4, -0.3, 0.7]))


def whole(track: Track) -> Segments:
    return Segments((track,))


def tracks(n: int, offset: float = 0.0, duration: float = 60.0, rate: float = 20.0) -> tuple[Track, Track]:
    """The root's and the sensor's trajectories, each from its first pose, by clocks that differ by an offset."""
    times: Array = np.arange(round(duration * rate)) / rate
    root, sensor = path(times, n), path(times, n) @ mounted(n)
    return (Track(times, se_n.inverse(root[0]) @ root), Track(times + offset, se_n.inverse(sensor[0]) @ sensor))


def motions(n: int, count: int = 100) -> tuple[Array, Array]:
    """Exact motions (K, n+1, n+1) of root and sensor."""
    starts: Array = np.arange(count) / 2
    root = se_n.inverse(path(starts, n)) @ path(starts + MOTION_DURATION, n)
    return root, se_n.inverse(mounted(n)) @ root @ mounted(n)


@DIMENSIONS
@pytest.mark.parametrize("offset", [-0.4137, -0.011, 0.0, 0.25, 0.333])
def test_the_clock_offset_is_found_within_two_milliseconds(n: int, offset: float) -> None:
    """At 10 Hz, with stamps of the sensor between those of the root."""
    times = np.arange(0, 60, 0.1)
    root = Track(times, path(times, n))
    sensor = Track(times + 0.04 + offset, path(times + 0.04, n) @ mounted(n))
    found, correlation = find_clock_offset(whole(root), whole(sensor), 0.5)
    assert found == pytest.approx(offset, abs=0.002)
    assert correlation > 0.999


@DIMENSIONS
@pytest.mark.parametrize("offset", [7200.25, -1e6])
def test_clocks_that_have_no_time_in_common_are_compared_by_turns_alone(n: int, offset: float) -> None:
    """Of which the second begins 12 s later: files of other programs have clocks of their own."""
    times = np.arange(0, 60, 0.1)
    root = Track(times, path(times, n))
    sensor = Track(times[120:] + offset, path(times[120:], n) @ mounted(n))
    found, correlation = find_clock_offset(whole(root), whole(sensor), 0.5)
    assert found == pytest.approx(offset, abs=0.002)
    assert correlation > 0.999


@DIMENSIONS
def test_the_clock_offset_is_found_between_sensors_of_different_rates(n: int) -> None:
    """Turn rates between two poses are of the time in the middle."""
    coarse, fine = np.arange(600) / 10, np.arange(1200) / 20
    root = Track(coarse, path(coarse, n))
    sensor = Track(fine + OFFSET, path(fine, n) @ mounted(n))
    assert find_clock_offset(whole(root), whole(sensor), 0.5)[0] == pytest.approx(OFFSET, abs=0.002)


def test_the_clock_offset_is_found_with_noise_of_turn_rates() -> None:
    """0.1° of each pose at 10 Hz, that is 1.4° per second of turn rates, leave 5 ms; on 20 seeds."""
    found = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        root, sensor = (
            Track(one.times, one.poses @ se_n.pose(se_n.exp(rng.normal(0, 0.00175, (600, 1))), np.zeros(2)))
            for one in tracks(2, OFFSET, rate=10.0)
        )
        found.append(find_clock_offset(whole(root), whole(sensor), 0.5)[0])
    assert np.std(found) < 0.01
    assert np.mean(found) == pytest.approx(OFFSET, abs=0.003)


def test_the_sign_of_turns_decides_in_the_plane() -> None:
    """A sensor whose scan plane is upside down turns the other way: no offset makes its turn rates agree."""
    root, sensor = tracks(2)
    _, right = find_clock_offset(whole(root), whole(sensor), 0.5)
    mirrored = Track(sensor.times, se_n.pose(se_n.transpose(se_n.rotation(sensor.poses)), np.zeros((1200, 2))))
    _, wrong = find_clock_offset(whole(root), whole(mirrored), 0.5)
    assert right > 0.999
    assert wrong < 0


@DIMENSIONS
def test_exact_tracks_of_one_clock_give_the_pose(n: int) -> None:
    root, sensor = tracks(n)
    start = solve_start(whole(root), whole(sensor), 0.0, np.random.default_rng(0))
    assert isinstance(start, MotionStart)
    assert_allclose(se_n.difference(start.T_root_sensor, mounted(n)), 0, atol=1e-6)
    assert start.inliers == 1
    assert start.clock_offset == 0
    assert start.correlation > 0.999


@DIMENSIONS
def test_tracks_of_different_clocks_give_pose_and_offset(n: int) -> None:
    """Interpolated between poses of 20 Hz."""
    root, sensor = tracks(n, OFFSET)
    start = solve_start(whole(root), whole(sensor), 0.5, np.random.default_rng(0))
    assert isinstance(start, MotionStart)
    assert start.clock_offset == pytest.approx(OFFSET, abs=0.002)
    assert_allclose(se_n.difference(start.T_root_sensor, mounted(n)), 0, atol=5e-3)


@DIMENSIONS
def test_wrong_motions_hardly_move_the_pose(n: int) -> None:
    """A fifth of them, by half a metre and 0.3 rad, on ten seeds."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        A, B = motions(n)
        wrong = rng.choice(len(B), len(B) // 5, replace=False)
        error = rng.normal(size=(len(wrong), n + n * (n - 1) // 2)) * np.repeat([0.5, 0.3], [n, n * (n - 1) // 2])
        B[wrong] = se_n.retract(B[wrong], error)
        T, weights = _solve_pose(A, B, rng)
        e = se_n.difference(T, mounted(n))
        assert np.abs(e).max() < 1e-3
        assert np.mean(weights[wrong] < 0.25) > 0.8
        assert np.mean(weights > 0.25) >= 0.8


@DIMENSIONS
def test_samples_find_the_pose_among_as_many_wrong_motions(n: int) -> None:
    """Half of them, by metres and radians, on ten seeds; what is left is refined."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        A, B = motions(n)
        wrong = rng.choice(len(B), len(B) // 2, replace=False)
        B[wrong] = se_n.retract(B[wrong], rng.normal(size=(len(wrong), n + n * (n - 1) // 2)))
        error = se_n.difference(_sample_poses(A, B, rng), mounted(n))
        assert np.abs(error).max() < 0.02


@DIMENSIONS
def test_inliers_are_the_share_of_motions_that_agree(n: int) -> None:
    """The sensor jumps by a metre every 10 s, in each of six intervals that three motions contain."""
    root, sensor = tracks(n)
    poses = sensor.poses.copy()
    for time in np.arange(5, 60, 10):
        poses[sensor.times >= time, 0, n] += 1.0
    start = solve_start(whole(root), whole(replace(sensor, poses=poses)), 0.5, np.random.default_rng(0))
    assert isinstance(start, MotionStart)
    assert start.inliers == pytest.approx(1 - 18 / 117, abs=0.01)
    assert_allclose(se_n.difference(start.T_root_sensor, mounted(n)), 0, atol=2e-3)


@DIMENSIONS
def test_the_jacobian_is_the_derivative_of_the_errors(n: int) -> None:
    A, B = motions(n, 20)
    T, step = mounted(n), 1e-6
    J = _jacobian(T, A, B)
    for k, change in enumerate(step * np.eye(J.shape[-1])):
        numerical = _errors(se_n.retract(T, change), A, B) - _errors(se_n.retract(T, -change), A, B)
        assert_allclose(J[:, :, k], numerical * _scale(n) / (2 * step), atol=1e-8)


@pytest.mark.parametrize("point", [(0.0, 0.0), (0.5, -0.3), (2.0, 0.0)])
def test_turns_about_one_point_leave_the_side_open(point: tuple[float, float]) -> None:
    """A robot that turns on the spot, or drives a circle of 2 m: odometry is exact but for 5 mm and 0.1°."""
    rng = np.random.default_rng(0)
    times = np.arange(600) / 10
    heading = 0.6 * np.sin(0.9 * times) + 0.4 * times + 0.2 * np.sin(1.7 * times)
    R = se_n.exp(heading[:, None])
    center = np.array(point)
    root = se_n.pose(R, center - R @ center)
    noisy = [
        se_n.retract(one, rng.normal(size=(600, 3)) * [0.005, 0.005, 0.002]) for one in (root, root @ mounted(2))
    ]
    start = solve_start(whole(Track(times, noisy[0])), whole(Track(times, noisy[1])), 0.5, rng)
    assert isinstance(start, MotionStart)
    assert start.travel < 0.05
    assert "turned about one point only" in explain_failure(start, "rear")


def test_a_drive_with_curves_leaves_no_side_open() -> None:
    root, sensor = tracks(2)
    start = solve_start(whole(root), whole(sensor), 0.5, np.random.default_rng(0))
    assert isinstance(start, MotionStart)
    assert start.travel > 0.5
    assert explain_failure(start, "rear") == ""
