"""Places of 2-D scanners by the surfaces that a 3-D LiDAR measured."""

import numpy as np
from numpy.testing import assert_array_equal

from calgraph.drive.measurements import DrivePart
from calgraph.drive.points_on_surfaces import associate_points
from calgraph.drive.segments import Segments
from calgraph.drive.sources.lidar import LidarSource
from calgraph.drive.start import MotionStart
from calgraph.drive.start_places import place_scanners
from calgraph.drive.sweeps import Sweep
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3, so3
from calgraph.surfaces.sensor_states import SensorPoints, SensorState
from calgraph.surfaces.trajectory import Track, fit_spline

CORNERS = np.array([4.0, 3.0, 1.5])
"""Half of a room, m."""
T_ROOT_SCANNER = se3.pose(so3.exp(np.array([0.04, -0.06, 2.5])), np.array([-0.5, 0.1, 0.35]))


def cast(T: Array, directions: Array) -> Array:
    """Where beams meet the room, in the frame of a sensor at a pose in it."""
    u = directions @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        ranges = ((np.sign(u) * CORNERS - T[:3, 3]) / u).min(axis=1)
    return np.asarray(directions * ranges[:, None])


def drive(rock: float) -> tuple[dict[str, LidarSource], dict[str, Segments | Rejected]]:
    """A LiDAR and a scanner on a robot that turns, and rocks by an angle, rad."""
    rng = np.random.default_rng(0)
    times = np.arange(0, 20, 0.1)
    angles = rock * np.stack([np.sin(2.1 * times), np.sin(3.3 * times + 1)], axis=1)
    R = so3.exp(np.column_stack([np.zeros((len(times), 2)), times])) @ so3.exp(np.pad(angles, ((0, 0), (0, 1))))
    poses = se3.pose(R, np.stack([np.sin(times), 0.7 * np.cos(0.6 * times), 0.1 * np.sin(times)], axis=1))
    turn = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    rings = rng.normal(size=(180, 3))
    ring = np.stack([np.cos(turn), np.sin(turn), np.zeros(180)], axis=1)
    found = {}
    for name, directions, T, flat in (
        ("root", rings / np.linalg.norm(rings, axis=1)[:, None], np.eye(4), False),
        ("scanner", ring, T_ROOT_SCANNER, True),
    ):
        sweeps = [
            Sweep(float(t), cast(pose @ T, directions), np.full(180, t), np.zeros((180, 3)))
            for t, pose in zip(times, poses, strict=True)
        ]
        found[name] = LidarSource(sweeps, 3, flat)
    return found, {"root": Segments([Track(times, poses)])}


def make_start() -> MotionStart:
    """A start by motions: level, at no height, turned by 0.1 rad too much."""
    T = se3.pose(so3.exp(np.array([0.0, 0.0, 2.6])), np.array([-0.45, 0.05, 0.0]))
    return MotionStart(T, 0.0, 0.7, 0.99, 50, np.array([0.3, 0.0, 0.0]), axis=np.array([0.0, 0.0, 1.0]))


def test_height_and_tilt_are_those_at_which_points_are_on_the_map() -> None:
    sources, tracks = drive(0.05)
    placed = place_scanners({"scanner": make_start()}, "root", tracks, sources, np.random.default_rng(1))[
        "scanner"
    ]
    assert isinstance(placed, MotionStart)
    error = se3.difference(placed.T_root_sensor, T_ROOT_SCANNER)
    assert np.abs(error[:3]).max() < 0.03
    assert np.degrees(np.abs(error[3:]).max()) < 0.4


def test_a_level_drive_leaves_height_and_tilt_open() -> None:
    sources, tracks = drive(0.003)
    starts: dict[str, MotionStart | Rejected] = {"scanner": make_start()}
    placed = place_scanners(starts, "root", tracks, sources, np.random.default_rng(1))["scanner"]
    assert isinstance(placed, Rejected)
    assert "the height, roll and pitch of scanner open" in placed.reason


def test_without_a_lidar_in_space_there_is_no_place() -> None:
    sources, tracks = drive(0.05)
    sources["odometry"] = None  # type: ignore[assignment]
    tracks["odometry"] = tracks["root"]
    starts: dict[str, MotionStart | Rejected] = {"scanner": make_start()}
    placed = place_scanners(starts, "odometry", tracks, sources, np.random.default_rng(1))["scanner"]
    assert isinstance(placed, Rejected)
    assert "no 3-D LiDAR" in placed.reason


def test_points_of_a_scanner_are_on_surfaces_and_show_none() -> None:
    """With lines of its points, walls would lean as a wrong height and tilt demand."""
    sources, tracks = drive(0.05)
    along = tracks["root"]
    assert isinstance(along, Segments)
    spline = fit_spline(along.tracks[0], 1.0, 15.0, 0.1)
    lidar, scanner = (source.points(1.0, 15.0) for source in sources.values())
    states = [SensorState(np.eye(4)), SensorState(T_ROOT_SCANNER)]
    both = associate_points(DrivePart([lidar, scanner], spline), states, 0.1)
    alone = associate_points(DrivePart([lidar, SensorPoints(np.zeros((0, 3)), np.zeros(0))], spline), states, 0.1)
    assert_array_equal(both.surfaces.center, alone.surfaces.center)
    assert np.mean(both.cell[1] >= 0) > 0.7
