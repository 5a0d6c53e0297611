"""Places from surfaces: heights of LiDARs by the floor, and of 2-D scanners by what a 3-D LiDAR measured."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from calgraph.drive.adjustment import Adjustment
from calgraph.drive.measurements import DrivePart
from calgraph.drive.points_on_surfaces import associate_points
from calgraph.drive.segments import Segments
from calgraph.drive.sources.lidar import LidarSource
from calgraph.drive.start import MotionStart
from calgraph.drive.start_places import add_heights, leave_open, place_scanners
from calgraph.drive.stated_poses import StatedPose
from calgraph.drive.sweeps import Sweep
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3, so3
from calgraph.surfaces.sensor_states import BESIDE_POSE, SensorPoints, SensorState
from calgraph.surfaces.surface_elimination import NoiseModel
from calgraph.surfaces.trajectory import Track, fit_spline

UP = so3.exp(np.array([0.2, -0.1, 0.3])) @ [0.0, 0.0, 1.0]
T_ROOT_SENSOR = se3.pose(so3.exp(np.array([0.1, -0.2, 2.5])), np.array([-0.5, 0.1, 0.2]))


def source(T_world_sensor: Array, walls: int, rng: np.random.Generator, floor: bool = True) -> LidarSource:
    """Points of a floor at z = 0, of a ceiling at 2.7 m with fewer, and of walls in between."""
    level = rng.uniform(-5, 5, (900, 3)) * [1, 1, 0] + rng.normal(0, 0.02, (900, 3))
    level[600:, 2] += 2.7
    angle = rng.uniform(0, 2 * np.pi, walls)
    around = np.stack([6 * np.cos(angle), 6 * np.sin(angle), rng.uniform(0, 2.7, walls)], axis=1)
    points = se3.apply(se3.inverse(T_world_sensor), np.concatenate([level if floor else level[:0], around]))
    return LidarSource([Sweep(0.0, points, np.zeros(len(points)), np.zeros(3))], 3, False)


def find(start_height: float, sign: float, floor: bool = True) -> MotionStart | Rejected:
    """The start of a sensor whose height is wrong, by an axis of turning that points up or down."""
    rng = np.random.default_rng(0)
    R = so3.exp(np.array([0.3, 0.2, 0.1]))
    # The root is 0.9 m above the floor; its axis of turning is vertical.
    T_world_root = se3.pose(R, np.array([0.0, 0, 0.9]))
    axis = sign * R.T @ [0.0, 0, 1]
    T = T_ROOT_SENSOR.copy()
    T[:3, 3] += start_height * axis
    start = MotionStart(T, 0.0, 0.7, 0.99, 50, np.array([0.3, 0.0, 0.0]), axis=axis)
    sources = {
        "root": source(T_world_root, 300, rng),
        "rear": source(T_world_root @ T_ROOT_SENSOR, 500, rng, floor),
    }
    return add_heights({"rear": start}, "root", sources, {})["rear"]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("height", [0.0, -0.4])
def test_the_height_is_that_at_which_both_measure_one_floor(height: float, sign: float) -> None:
    found = find(height, sign)
    assert isinstance(found, MotionStart)
    assert_allclose(found.T_root_sensor, T_ROOT_SENSOR, atol=0.01)


def test_without_a_common_floor_the_height_is_open() -> None:
    found = find(0.0, 1.0, floor=False)
    assert isinstance(found, MotionStart)
    assert found.open_height


def test_open_heights_are_as_uncertain_as_robots_are_high() -> None:
    """Of the first of two sensors beside the one that leads, whose pose and clock are free."""
    free = np.zeros((3, 6 + BESIDE_POSE), dtype=bool)
    free[1:, :7] = True
    known = np.diag(np.tile([*[1e-4] * 3, *[1e-6] * 3, 1e-8], 2))
    adjusted = Adjustment(
        [SensorState(np.eye(4))] * 3, [], known, known, free, NoiseModel(np.ones(3), np.ones(4)),
        np.zeros((3, 3)), np.zeros(3), 0.0, responses=[],
    )  # fmt: skip
    start = MotionStart(T_ROOT_SENSOR, 0.0, 0.7, 0.99, 50, np.full(3, 0.3), axis=UP)
    widened = leave_open(adjusted, [replace(start, open_height=True), start]).covariance
    change = widened - known
    assert UP @ change[:3, :3] @ UP == pytest.approx(1.0)
    assert np.abs(change[:3, :3] @ np.cross(UP, [1.0, 0.0, 0.0])).max() < 1e-12
    change[:3, :3] = 0.0
    assert np.abs(change).max() == 0.0


def test_heights_are_open_against_a_root_of_open_height() -> None:
    start = MotionStart(T_ROOT_SENSOR, 0.0, 0.7, 0.99, 50, np.full(3, 0.3), axis=UP)
    assert start.relative_to(replace(start, open_height=True)).open_height
    assert not start.relative_to(start).open_height


def test_a_stated_height_is_taken() -> None:
    axis = np.array([0.0, 0, 1])
    start = MotionStart(T_ROOT_SENSOR, 0.0, 0.7, 0.99, 50, np.array([0.3, 0.0, 0.0]), axis=axis)
    T = T_ROOT_SENSOR.copy()
    T[:3, 3] += [0.3, -0.2, 0.5]
    rng = np.random.default_rng(0)
    sources = {name: source(np.eye(4), 300, rng, floor=False) for name in ("root", "rear")}
    found = add_heights({"rear": start}, "root", sources, {"rear": StatedPose(T, np.eye(6))})["rear"]
    assert isinstance(found, MotionStart)
    assert_allclose(found.T_root_sensor[:3, 3] - T_ROOT_SENSOR[:3, 3], [0, 0, 0.5])


def test_other_starts_stay() -> None:
    start = MotionStart(T_ROOT_SENSOR, 0.0, 0.7, 0.99, 50, np.full(3, 0.3))
    rejected = Rejected("why")
    sources = dict.fromkeys(("root", "rear", "left"), LidarSource([], 3, False))
    assert add_heights({"rear": start, "left": rejected}, "root", sources, {}) == {"rear": start, "left": rejected}


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
