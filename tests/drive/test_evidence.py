"""What reports of drives show: levelled trajectories, points on surfaces with residuals, and the start."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calgraph.drive.adjustment import Adjustment
from calgraph.drive.evidence import _MAX_POINTS, collect_pictures
from calgraph.drive.measurements import DrivePart
from calgraph.drive.points_on_surfaces import associate_points
from calgraph.drive.start import MotionStart
from calgraph.errors import Rejected
from calgraph.geometry import Array, se2, se3, se_n
from calgraph.result import Pictures
from calgraph.surfaces.placed_points import find_incidence, place_points
from calgraph.surfaces.sensor_states import SensorPoints, SensorState
from calgraph.surfaces.surface_elimination import NoiseModel
from calgraph.surfaces.trajectory import Track, fit_spline
from drive_scenes import beams_in_plane, beams_in_space, drive, scan

CLOCK, BIAS, SCALE, NOISE = 0.07, 0.04, 0.002, 0.004
ROOT = {2: np.eye(3), 3: se_n.pose(se_n.exp(np.array([0.5, -0.2, 1.0])), np.zeros(3))}
"""The root is tilted on the robot, or upside-down."""
OVERHEAD = se_n.pose(se_n.exp(np.array([np.pi, 0.0, 0.0])), np.zeros(3))
REAR = {
    2: se_n.pose(se_n.exp(np.array([2.8])), np.array([-0.5, 0.1])),
    3: se_n.pose(se_n.exp(np.array([0.2, 0.1, 2.8])), np.array([-0.5, 0.1, 0.2])),
}


def simulate(n: int, T_base_root: Array, duration: float = 6.0) -> tuple[DrivePart, list[SensorState]]:
    """A robot whose trajectory is known; the second sensor has another clock and errors of ranges."""
    rng = np.random.default_rng(n)
    beams = beams_in_plane(3.0) if n == 2 else beams_in_space(8, 8.0)
    world = T_base_root if n == 3 else se_n.pose(se_n.exp(np.array([0.3])), np.zeros(2))
    states = [SensorState(np.eye(n + 1)), SensorState(REAR[n], CLOCK, BIAS, SCALE)]
    points = []
    for state in states:
        sweeps = scan(beams, T_base_root @ state.T_root_sensor, duration, NOISE, rng)
        x, times = (np.concatenate([getattr(one, name) for one in sweeps]) for name in ("points", "times"))
        ranges = np.linalg.norm(x, axis=1, keepdims=True)
        long = x * (ranges + state.range_bias) / (1 - state.range_scale) / ranges
        points.append(SensorPoints(long, times + state.clock_offset))
    times = np.arange(round(duration * 20) + 1) / 20
    track = Track(times, se_n.inverse(world) @ drive(times, n) @ T_base_root)
    return DrivePart(points, fit_spline(track, 0.0, duration, 0.1)), states


def collect(part: DrivePart, states: list[SensorState], root: int = 0) -> Pictures:
    n = part.trajectory.reference.poses.shape[-1] - 1
    start = MotionStart(np.eye(n + 1), 0.02, 1.0, 1.0, 10, np.ones(n * (n - 1) // 2))
    starts: dict[str, MotionStart | Rejected] = {"rear": start, "lost": Rejected("no")}
    return collect_pictures(["front", "rear"], starts, adjust([part], states), root)


def adjust(parts: list[DrivePart], states: list[SensorState]) -> Adjustment:
    """A solution that is known, with its surfaces."""
    empty, associations = np.zeros((0, 0)), [associate_points(part, states, 0.09) for part in parts]
    noise, free = NoiseModel(np.zeros(2), np.zeros(2)), np.zeros((2, 9), dtype=bool)
    return Adjustment(
        states, parts, empty, empty, free, noise, empty, empty, 0.0, associations=associations
    )  # fmt: skip


@pytest.mark.parametrize("n", [2, 3])
def test_points_are_on_the_walls_by_path_and_pose(n: int) -> None:
    part, states = simulate(n, ROOT[n])
    pictures = collect(part, states)
    (path,) = pictures.drive_paths
    assert [view.sensor for view in pictures.drive_views] == ["front", "rear"]
    for view, state in zip(pictures.drive_views, states, strict=True):
        T = state.T_root_sensor if n == 3 else se2.to_se3(state.T_root_sensor)
        world = place_points(view, path, T)
        axis = np.argmax(np.abs(view.normals), axis=1)
        # Walls run along x and y, and the world is level: normals are along the axes.
        along = np.abs(view.normals[np.arange(len(axis)), axis]) > 0.99
        assert along.mean() > 0.9
        for k in range(n):
            sides = world[along & (axis == k), k]
            for side in (sides[sides > sides.mean()], sides[sides <= sides.mean()]):
                # Boxes have walls before those of the room.
                off = np.abs(side - np.median(side))
                assert np.median(off[off < 0.3]) < 0.02
        assert np.median(np.abs(view.residuals)) < 0.01
        assert view.shared.mean() > 0.5
        incidence = find_incidence(view, path, T)
        assert incidence.min() >= 0
        assert incidence.max() <= 90
        # Normals point away from the sensor.
        beams = world - Track(path.times, path.T_world_root @ T).at(view.times)[:, :3, 3]
        assert np.all(np.einsum("ni,ni->n", beams, view.normals) > 0)


@pytest.mark.parametrize("T_base_root", [ROOT[3], OVERHEAD])
def test_the_world_is_level_with_the_floor_below(T_base_root: Array) -> None:
    pictures = collect(*simulate(3, T_base_root))
    (path,) = pictures.drive_paths
    up = path.T_world_root[:, :3, :3] @ T_base_root[:3, :3].T
    # The robot itself sways by 0.05 rad.
    assert up[:, 2, 2].mean() > 0.99
    heights = [
        (np.median(world[level, 2]), np.median(path.T_world_root[:, 2, 3]))
        for view in pictures.drive_views[:1]
        for world in [place_points(view, path, np.eye(4))]
        for level in [view.normals[:, 2] < -0.9]
    ]
    assert heights[0][0] < heights[0][1]


def test_the_path_starts_at_zero_and_has_the_poses_of_the_trajectory() -> None:
    part, states = simulate(2, ROOT[2])
    (path,) = collect(part, states).drive_paths
    assert path.times[0] == 0.0
    assert path.times[-1] == pytest.approx(part.trajectory.end)
    moved = se3.inverse(path.T_world_root[0]) @ path.T_world_root[-1]
    ends = part.trajectory.at(np.array([0.0, part.trajectory.end])).poses
    expected = se_n.inverse(ends[0]) @ ends[1]
    assert_allclose(moved[:2, 3], expected[:2, 2], atol=1e-9)
    assert_allclose(moved[:2, :2], expected[:2, :2], atol=1e-9)


@pytest.mark.parametrize("n", [2, 3])
def test_the_path_may_be_of_another_sensor_than_the_first(n: int) -> None:
    """Its points are where they were, by poses against it."""
    part, states = simulate(n, ROOT[n])
    pictures, moved = collect(part, states), collect(part, states, 1)
    T = [state.T_root_sensor if n == 3 else se2.to_se3(state.T_root_sensor) for state in states]
    for one, other, pose in zip(pictures.drive_views, moved.drive_views, T, strict=True):
        before = place_points(one, pictures.drive_paths[0], pose)
        after = place_points(other, moved.drive_paths[0], se3.inverse(T[1]) @ pose)
        assert_allclose(after, before, atol=1e-3)


def test_the_start_is_kept_of_sensors_that_were_adjusted() -> None:
    (start,) = collect(*simulate(2, ROOT[2])).drive_starts
    assert (start.sensor, start.clock_offset) == ("rear", 0.02)
    assert_allclose(start.T_root_sensor, np.eye(4))


def test_points_are_thinned_over_all_parts() -> None:
    part, states = simulate(3, ROOT[3], 12.0)
    pictures = collect_pictures(["front", "rear"], {}, adjust([part, part], states))
    for name in ("front", "rear"):
        kept = [len(view.times) for view in pictures.drive_views if view.sensor == name]
        assert len(kept) == 2
        assert _MAX_POINTS / 2 < sum(kept) <= _MAX_POINTS
        assert len(part.points[0].times) > _MAX_POINTS


def test_sensors_without_points_have_a_path_alone() -> None:
    part, states = simulate(3, ROOT[3])
    none = SensorPoints(np.zeros((0, 3)), np.zeros(0))
    bare = DrivePart([none, none], part.trajectory)
    pictures = collect(bare, states)
    assert pictures.drive_views == ()
    assert len(pictures.drive_paths) == 1
