"""Trajectories of simulated LiDARs that drive through rooms of boxes, against the poses that are known."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calgraph.drive.odometry import track_sensor
from calgraph.drive.sources.lidar import LidarSource
from calgraph.drive.sweeps import Sweep
from calgraph.errors import Rejected
from calgraph.geometry import Array, se_n, so3
from calgraph.surfaces.trajectory import Track
from drive_scenes import beams_in_plane, beams_in_space, drive, scan

NOISE = 0.01


def errors(
    track: Track, T_root_sensor: Array, since: float = 0.0, path: Callable[[Array, int], Array] = drive
) -> tuple[Array, Array]:
    """Distances, m, and angles, degrees, between poses and the known ones in the frame of the first."""
    n = len(T_root_sensor) - 1
    T = path(track.times + since, n) @ T_root_sensor
    e = se_n.difference(track.poses, se_n.inverse(T[0]) @ T)
    return np.linalg.norm(e[:, :n], axis=1), np.degrees(np.linalg.norm(e[:, n:], axis=1))


def planar_sweeps(seed: int, duration: float = 20.0) -> list[Sweep]:
    return scan(beams_in_plane(), np.eye(3), duration, NOISE, np.random.default_rng(seed))


def test_a_scanner_in_the_plane_is_tracked_through_a_room() -> None:
    track = track_sensor(planar_sweeps(0), 600, np.random.default_rng(0))
    distance, angle = errors(track, np.eye(3))
    assert len(track.times) == 200
    assert distance.max() < 0.02
    assert angle.max() < 0.2


def test_a_scanner_that_points_backwards_is_tracked() -> None:
    T = se_n.pose(se_n.exp(np.array([2.8])), np.array([-0.4, 0.2]))
    sweeps = scan(beams_in_plane(1.0), T, 10.0, NOISE, np.random.default_rng(0))
    distance, angle = errors(track_sensor(sweeps, 600, np.random.default_rng(0)), T)
    assert distance.max() < 0.03
    assert angle.max() < 0.3


def test_a_lidar_in_space_is_tracked_through_a_room() -> None:
    """16 rings within 15° of the horizon meet few points of floor and ceiling: heights are the least certain."""
    sweeps = scan(beams_in_space(), np.eye(4), 20.0, NOISE, np.random.default_rng(0))
    track = track_sensor(sweeps, 1000, np.random.default_rng(0))
    distance, angle = errors(track, np.eye(4))
    assert distance[-1] < 0.05
    assert angle[-1] < 0.5
    T = drive(track.times, 3)
    across = track.poses[:, :2, 3] - (se_n.inverse(T[0]) @ T)[:, :2, 3]
    assert np.abs(across).max() < 0.03


def floor_sweeps(sector: float, pitch: float) -> tuple[Array, list[Sweep]]:
    """The pose of a LiDAR that looks down, angles in degrees, and its sweeps of 15 s."""
    directions, times = beams_in_space(16, 0.8)
    seen = np.abs(np.degrees(np.arctan2(directions[:, 1], directions[:, 0]))) < sector / 2
    T = se_n.pose(so3.exp(np.array([0.0, np.radians(pitch), 0.0])), np.array([0.3, 0.0, 0.0]))
    beams = directions[seen], times[seen]
    return T, scan(beams, T, 15.0, NOISE, np.random.default_rng(0))


def test_a_lidar_that_measures_floor_at_four_of_five_points_is_tracked() -> None:
    """Of points at random, few are of walls, and a scale of 0.1 m for all of them leaves it to the prediction."""
    T, sweeps = floor_sweeps(130, 30)
    track = track_sensor(sweeps, 300, np.random.default_rng(0))
    distance, _ = errors(track, T)
    assert distance.max() < 0.1
    assert (track.stddev < 0.05).mean() > 0.95


def test_a_lidar_that_measures_floor_only_has_no_odometry() -> None:
    _, sweeps = floor_sweeps(60, 45)
    track = LidarSource(sweeps, 3, False).track(np.random.default_rng(0))
    assert isinstance(track, Rejected)
    assert "show its motion in" in track.reason


def test_a_drive_that_begins_in_motion_is_tracked() -> None:
    """Nothing is known of the velocity in the first sweep, which is the first map."""
    sweeps = planar_sweeps(0)[30:]
    since = sweeps[0].time
    shifted = [replace(one, time=one.time - since, times=one.times - since) for one in sweeps]
    distance, angle = errors(track_sensor(shifted, 600, np.random.default_rng(0)), np.eye(3), since)
    assert distance[-1] < 0.05
    assert angle[-1] < 0.5


def spin(times: Array, n: int) -> Array:
    """A robot that stands, turns at 4 rad/s from one sweep to the next for one second, and stands."""
    turn = 4.0 * (np.maximum(times - 1.5, 0) - np.maximum(times - 2.5, 0))
    return se_n.pose(se_n.exp(turn[:, None]), np.zeros((len(times), n)))


@pytest.mark.parametrize("seed", range(3))
def test_a_sudden_turn_is_found_around_the_prediction(seed: int) -> None:
    sweeps = scan(beams_in_plane(), np.eye(3), 4.0, NOISE, np.random.default_rng(seed), spin)
    distance, angle = errors(track_sensor(sweeps, 600, np.random.default_rng(seed)), np.eye(3), path=spin)
    assert distance[-1] < 0.05
    assert angle[-1] < 0.5


def test_the_motion_within_sweeps_is_corrected() -> None:
    def at_one_time(sweeps: Sequence[Sweep]) -> list[Sweep]:
        return [replace(one, times=np.full_like(one.times, one.time)) for one in sweeps]

    sweeps = planar_sweeps(0, 6.0)
    corrected, rigid = (
        errors(track_sensor(some, 600, np.random.default_rng(0)), np.eye(3))[0].max()
        for some in (sweeps, at_one_time(sweeps))
    )
    assert corrected < 0.02
    assert rigid > 3 * corrected


def test_an_empty_sweep_continues_the_motion() -> None:
    sweeps = planar_sweeps(0, 5.0)
    sweeps[30] = sweeps[30].select(np.zeros(0, dtype=np.intp))
    distance, angle = errors(track_sensor(sweeps, 600, np.random.default_rng(0)), np.eye(3))
    assert distance[30] < 0.02
    assert angle[30] < 1.0
    assert distance[-1] < 0.02


def test_the_first_pose_is_the_origin_at_the_time_of_the_first_sweep() -> None:
    track = track_sensor(planar_sweeps(0, 0.5), 600, np.random.default_rng(0))
    assert_allclose(track.poses[0], np.eye(3))
    assert_allclose(np.diff(track.times), 0.1)
    assert track.times[0] == pytest.approx(0.0375)
