"""The vehicle's frame: paths whose axle does not slide, floors of known height and tilt."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calgraph.drive.adjustment import Adjustment
from calgraph.drive.measurements import DrivePart
from calgraph.drive.segments import Segments
from calgraph.drive.vehicle import Wheels, fit_pose, fit_side, join_chords, locate_root, scatter_of
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3, se_n, so3
from calgraph.surfaces.floor import measure_level
from calgraph.surfaces.sensor_states import BESIDE_POSE, TIMING, SensorPoints, SensorState
from calgraph.surfaces.surface_elimination import NoiseModel
from calgraph.surfaces.trajectory import Track, fit_spline

STEP = 0.1
T_BASE_ROOT = se3.pose(so3.exp(np.array([0.05, -0.2, 0.7])), np.array([0.6, 0.25, 0.9]))


def wander(duration: float, rng: np.random.Generator, turn: float = 0.5, slip: float = 0.0) -> Array:
    """(K, 4, 4) poses of a base that drives ahead, stops, reverses and turns; integrated in fine steps.

    With slip (s²/m) the centre of the axle moves to the outside of curves.
    """
    times = np.arange(0, duration, STEP / 20)
    speed = 0.6 + 0.6 * np.sin(0.4 * times + rng.uniform(0, 6))
    turns = turn * np.sin(0.7 * times + rng.uniform(0, 6)) * (1 + 0.5 * np.sin(0.23 * times))
    yaw = np.cumsum(turns) * STEP / 20
    sideways = -slip * np.abs(speed) * speed * turns
    heading = yaw - turns * STEP / 40
    velocity = np.stack([
        speed * np.cos(heading) - sideways * np.sin(heading), speed * np.sin(heading) + sideways * np.cos(heading)
    ], axis=1)  # fmt: skip
    place = np.column_stack([np.cumsum(velocity, axis=0) * STEP / 20, np.zeros(len(times))])
    T = se3.pose(so3.exp(yaw[:, None] * np.array([0.0, 0.0, 1.0])), place)
    return np.asarray(T[::20])


def level_of(T_base_root: Array, count: int) -> Array:
    """(count, 6) of a flat floor."""
    up = T_base_root[2, :3]
    return np.tile([*up, *(-T_base_root[2, 3] * up)], (count, 1))


def error_of(found: Array, truth: Array = T_BASE_ROOT) -> Array:
    """(6,) in the axes of the vehicle, without y, which a drive does not determine."""
    error = se3.difference(found, truth)
    error[1] = 0.0
    return error


def estimate(base: Array, rng: np.random.Generator | None = None, noise: float = 0.0) -> tuple[Array, Array]:
    """The pose of the root and its covariance, from its path with errors that last for a second, m."""
    root = base @ T_BASE_ROOT
    if rng is not None:
        wrong = np.repeat(rng.normal(size=(len(root) // 10 + 1, 6)), 10, axis=0)[: len(root)]
        root = se3.retract(root, (wrong + rng.normal(size=wrong.shape)) * noise)
    chords = join_chords(root, level_of(T_BASE_ROOT, len(root) - 1), np.zeros(3))
    pose = fit_pose(chords)
    assert not isinstance(pose, Rejected)
    covariance = scatter_of(chords, pose)
    assert not isinstance(covariance, Rejected)
    return pose, covariance


@pytest.mark.parametrize("seed", range(3))
def test_an_axle_that_does_not_slide_gives_heading_and_place(seed: int) -> None:
    pose, covariance = estimate(wander(60.0, np.random.default_rng(seed)))
    error = error_of(pose)
    assert np.abs(error[:3]).max() < 5e-4
    assert np.abs(error[3:]).max() < 2e-4
    assert covariance[0, 0] < 5e-4**2


def test_covariances_are_those_of_the_errors() -> None:
    """Of x and yaw, whose errors over 24 drives with errors of trajectories that last for a second."""
    distances = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        pose, covariance = estimate(wander(60.0, rng), rng, 1e-3)
        error, of = error_of(pose), np.array([0, 5])
        distances.append(error[of] @ np.linalg.solve(covariance[np.ix_(of, of)], error[of]) / 2)
    assert 0.5 < np.mean(distances) < 1.6


def test_slip_of_tyres_is_allowed_for() -> None:
    """At 0.6 m/s on average it moves the axis of turning by up to 12 mm."""
    pose, _ = estimate(wander(60.0, np.random.default_rng(1), slip=0.01))
    assert abs(error_of(pose)[0]) < 2e-3


def test_a_body_dives_by_the_acceleration_of_its_axle() -> None:
    """The root, 1.5 m ahead, is accelerated backwards in all curves: of it, the pitch at rest would be wrong."""
    T_base_root = se3.pose(np.eye(3), np.array([1.5, 0.0, 0.9]))
    base = wander(60.0, np.random.default_rng(0), turn=0.8)
    velocity = np.gradient(base[:, :3, 3], STEP, axis=0)
    acceleration = np.einsum("kji,kj->ki", base[:, :3, :3], np.gradient(velocity, STEP, axis=0))[:, 0]
    lean = so3.exp(-0.01 * acceleration[:, None] * np.array([0.0, 1.0, 0.0]))
    root = base @ se3.pose(lean, np.zeros(3)) @ T_base_root
    level = level_of(T_base_root, len(base) - 1)
    level[:, :3] = lean[:-1, 2]
    errors = []
    for axle in (-T_base_root[:3, 3], np.zeros(3)):
        pose = fit_pose(join_chords(root, level, axle))
        assert not isinstance(pose, Rejected)
        errors.append(abs(error_of(pose, T_base_root)[4]))
    assert errors[0] < 1e-4
    assert errors[1] > 5e-4


@pytest.mark.parametrize("share", [0.0, 0.05])
def test_a_vehicle_that_only_turns_on_the_spot_has_no_front(share: float) -> None:
    base = wander(60.0, np.random.default_rng(0))
    base[:, :3, 3] *= share
    found = fit_pose(join_chords(base @ T_BASE_ROOT, level_of(T_BASE_ROOT, len(base) - 1), np.zeros(3)))
    assert isinstance(found, Rejected)
    assert "hardly drove straight on" in found.reason


def test_turns_on_the_spot_determine_the_place_of_the_axle() -> None:
    ahead = wander(30.0, np.random.default_rng(0), turn=0.02)
    turns = so3.exp(np.linspace(0, 12, 300)[:, None] * np.array([0.0, 0.0, 1.0]))
    spot = ahead[-1] @ se3.pose(turns, np.zeros((300, 3)))
    pose, covariance = estimate(np.concatenate([ahead, spot]), np.random.default_rng(0), 1e-3)
    assert abs(error_of(pose)[0]) < 2e-3
    assert covariance[0, 0] < 2e-3**2


def test_a_drive_to_and_fro_does_not_show_the_front() -> None:
    half = wander(30.0, np.random.default_rng(0))
    base = np.concatenate([half, half[::-1]])
    found = fit_pose(join_chords(base @ T_BASE_ROOT, level_of(T_BASE_ROOT, len(base) - 1), np.zeros(3)))
    assert isinstance(found, Rejected)
    assert "backwards as far as ahead" in found.reason


def floor_points(path: Array, rng: np.random.Generator, slope: float = 0.0, ceiling: float = 3.0) -> Array:
    """(N, 3) of a floor below a path with a slope along x, a table, and a ceiling, with 3 mm of noise."""
    along = path[rng.integers(0, len(path), 15_000), :2, 3]
    xy = along + rng.uniform(-3, 3, along.shape)
    table = along[0] + rng.uniform(1.5, 3.0, (1000, 2))
    z = [slope * xy[:, 0], np.full(len(table), 0.7), ceiling + 0 * xy[:, 0]]
    points = np.column_stack([np.concatenate([xy, table, xy]), np.concatenate(z)])
    return np.asarray(points + rng.normal(0, 0.003, points.shape), dtype=np.float64)


@pytest.mark.parametrize("inverted", [False, True])
def test_floor_below_a_path_gives_height_and_tilt(inverted: bool) -> None:
    """The world of a drive is tilted as its first pose; a ceiling is as near as the floor."""
    rng = np.random.default_rng(0)
    slope = np.radians(4)
    T_base_root = T_BASE_ROOT @ np.diag([1.0, -1.0, -1.0, 1.0]) if inverted else T_BASE_ROOT
    tilt = se3.pose(so3.exp(np.array([0.0, -slope, 0.0])), np.zeros(3))
    root = tilt @ wander(60.0, rng) @ T_base_root
    points = floor_points(root, rng, np.tan(slope), 1.8)
    world = se3.inverse(root[0])
    up = np.array([0.0, 0.0, -1.0 if inverted else 1.0])
    level = measure_level(se3.apply(world, points), world @ root, up, np.zeros((2, 3)))
    known = np.isfinite(level).all(axis=1)
    assert known.mean() > 0.5
    np.testing.assert_allclose(np.median(level[known, :3], axis=0), T_base_root[2, :3], atol=2e-3)
    height = -np.sum(level[known, :3] * level[known, 3:], axis=1)
    assert np.median(height) == pytest.approx(T_base_root[2, 3], abs=2e-3)


def adjusted_drive(poses: Array, points: Array) -> Adjustment:
    """A drive that is adjusted without errors: one part, one sensor with some range bias left."""
    n = poses.shape[-1] - 1
    times = STEP * np.arange(len(poses), dtype=np.float64)
    trajectory = fit_spline(Track(times, poses), 0.0, float(times[-1]), STEP)
    at = trajectory.at(np.linspace(0, times[-1], len(points))).poses
    local = (se_n.transpose(se_n.rotation(at)) @ (points - se_n.translation(at))[:, :, None])[..., 0]
    free: NDArray[np.bool_] = np.zeros((1, n + n * (n - 1) // 2 + BESIDE_POSE), dtype=bool)
    free[0, -TIMING - 2 : -TIMING] = True
    part = DrivePart([SensorPoints(local, np.linspace(0, times[-1], len(points)))], trajectory)
    return Adjustment(
        [SensorState(np.eye(n + 1))], [part], np.diag([1e-6, 1e-8]), np.diag([1e-6, 1e-8]),
        free, NoiseModel(np.full(1, 0.01), np.full(2, 0.005)),
        np.zeros((1, 1)), np.zeros(1), 0.0,
        responses=[np.zeros((trajectory.control.size, 2))],
    )  # fmt: skip


def test_the_root_is_located_from_an_adjusted_drive() -> None:
    rng = np.random.default_rng(3)
    root = wander(60.0, rng) @ T_BASE_ROOT
    world = se3.inverse(root[0])
    found = locate_root(adjusted_drive(world @ root, se3.apply(world, floor_points(root, rng))))
    assert not isinstance(found, Rejected)
    error = error_of(found.T_base_root)
    assert np.abs(error[:3]).max() < 3e-3
    assert np.abs(error[3:]).max() < 1e-3
    assert found.T_base_root[1, 3] == 0
    assert np.isnan(np.diag(found.covariance)).tolist() == [False, True, False, False, False, False]


def measure_wheels(base: Array, scale: float = 1.0, rng: np.random.Generator | None = None) -> Array:
    """(K - 1,) distances of the axle's centre with an error of the radius, and slip of 0.5 % that lasts 1 s."""
    ahead = np.einsum("ki,ki->k", np.diff(base[:, :3, 3], axis=0), (base[1:, :3, 0] + base[:-1, :3, 0]) / 2)
    slip = np.zeros(len(ahead)) if rng is None else np.repeat(rng.normal(0, 0.005, len(ahead) // 10 + 1), 10)
    return np.asarray(scale * ahead * (1 + slip[: len(ahead)]), dtype=np.float64)


@pytest.mark.parametrize("scale", [0.97, 1.0, 1.02])
def test_distances_of_wheels_determine_how_far_the_root_is_to_the_side(scale: float) -> None:
    base = wander(60.0, np.random.default_rng(0))
    chords = join_chords(
        base @ T_BASE_ROOT, level_of(T_BASE_ROOT, len(base) - 1), np.zeros(3), measure_wheels(base, scale)
    )
    pose = fit_pose(chords)
    assert not isinstance(pose, Rejected)
    assert np.abs(se3.difference(pose, T_BASE_ROOT)[:3]).max() < 5e-4


def test_the_variance_of_the_side_is_that_of_its_errors() -> None:
    distances = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        base = wander(60.0, rng)
        travelled = measure_wheels(base, 1.01, rng)
        chords = join_chords(base @ T_BASE_ROOT, level_of(T_BASE_ROOT, len(base) - 1), np.zeros(3), travelled)
        pose = fit_pose(chords)
        assert not isinstance(pose, Rejected)
        scatter = scatter_of(chords, pose)
        assert not isinstance(scatter, Rejected)
        distances.append((pose[1, 3] - T_BASE_ROOT[1, 3]) ** 2 / scatter[1, 1])
    assert 0.4 < np.mean(distances) < 2.0


def test_curves_to_one_side_leave_the_side_as_uncertain_as_the_radius_of_wheels() -> None:
    """On a circle of 4 m a wheel that is 5 % larger looks like a root that is 0.2 m further to the left."""
    turns = np.linspace(0, 12, 600)
    place = 4.0 * np.column_stack([np.sin(turns), 1 - np.cos(turns), 0 * turns])
    base = se3.pose(so3.exp(turns[:, None] * np.array([0.0, 0.0, 1.0])), place)
    chords = join_chords(
        base @ T_BASE_ROOT, level_of(T_BASE_ROOT, len(base) - 1), np.zeros(3), measure_wheels(base, 1.03)
    )
    side, variance, _ = fit_side(chords, T_BASE_ROOT)
    assert abs(side - T_BASE_ROOT[1, 3]) < 2 * np.sqrt(variance)
    assert np.sqrt(variance) == pytest.approx(0.2, rel=0.1)


def test_wheels_have_a_clock_and_gaps() -> None:
    """Their clock is 0.3 s ahead, and their trajectory ends after 40 s of 60."""
    rng = np.random.default_rng(3)
    base = wander(60.0, rng)
    world = se3.inverse(base[0] @ T_BASE_ROOT)
    drive = adjusted_drive(world @ base @ T_BASE_ROOT, se3.apply(world, floor_points(base @ T_BASE_ROOT, rng)))
    drive = replace(drive, states=[replace(drive.states[0], clock_offset=0.3)])
    track = Track(0.3 + STEP * np.arange(400.0), base[:400])
    found = locate_root(drive, wheels=Wheels(0, Segments([track])))
    assert not isinstance(found, Rejected)
    assert np.isfinite(found.covariance).all()
    assert abs(se3.difference(found.T_base_root, T_BASE_ROOT)[1]) < 3e-3
    assert found.wheel_error < 0.01
    other = Wheels(0, Segments([Track(track.times, wander(60.0, rng)[:400])]))
    contradicted = locate_root(drive, wheels=other)
    assert not isinstance(contradicted, Rejected)
    assert contradicted.wheel_error > 0.3


def test_the_root_may_be_another_sensor_than_that_of_the_trajectory() -> None:
    """Its pose is uncertain by a centimetre ahead, and the vehicle's frame with it; it measures no points."""
    rng = np.random.default_rng(3)
    mounted = se3.pose(so3.exp(np.array([0.3, -0.1, 1.2])), np.array([0.4, -0.2, 0.3]))
    lead = wander(60.0, rng) @ T_BASE_ROOT @ se3.inverse(mounted)
    world = se3.inverse(lead[0])
    drive = adjusted_drive(world @ lead, se3.apply(world, floor_points(lead, rng)))
    ahead = np.zeros(8 + BESIDE_POSE)
    ahead[2:5] = 0.01 * mounted[:3, :3] @ T_BASE_ROOT[0, :3]
    none, more = SensorPoints(np.zeros((0, 3)), np.zeros(0)), 6 + BESIDE_POSE
    free = np.concatenate([drive.free, np.ones((1, more), dtype=bool)])
    tiny = np.pad(drive.covariance, (0, more)) + 1e-14 * np.eye(2 + more)
    both = replace(
        drive,
        states=[*drive.states, SensorState(mounted)],
        parts=[replace(part, points=[*part.points, none]) for part in drive.parts],
        free=free, responses=[np.pad(drive.responses[0], ((0, 0), (0, more)))],
        covariance=tiny + np.outer(ahead, ahead),
    )  # fmt: skip
    found, exact = locate_root(both, 1), locate_root(replace(both, covariance=tiny), 1)
    assert not isinstance(found, Rejected)
    assert not isinstance(exact, Rejected)
    error = error_of(found.T_base_root)
    assert np.abs(error[:3]).max() < 3e-3
    assert np.abs(error[3:]).max() < 1e-3
    assert found.covariance[0, 0] - exact.covariance[0, 0] == pytest.approx(1e-4, rel=0.1)


@pytest.mark.parametrize(("stddev", "low"), [(0.2, False), (0.003, True)])
def test_sensors_whose_poses_are_uncertain_measure_no_floor(stddev: float, low: bool) -> None:
    """Another one states a floor 0.2 m below that of the root, where the root measures its own as well."""
    rng = np.random.default_rng(3)
    root = wander(60.0, rng) @ T_BASE_ROOT
    world = se3.inverse(root[0])
    drive = adjusted_drive(world @ root, se3.apply(world, floor_points(root, rng)))
    part = drive.parts[0]
    free = np.repeat(drive.free, 2, axis=0)
    free[1] = [True] * 6 + [False] * BESIDE_POSE
    below = SensorState(se3.pose(np.eye(3), -0.2 * T_BASE_ROOT[2, :3]))
    both = Adjustment(**{
        **vars(drive), "free": free, "states": [*drive.states, below],
        "parts": [DrivePart([part.points[0], part.points[0]], part.trajectory)],
        "covariance": np.diag([1e-6, 1e-8, *[stddev**2] * 3, *[1e-6] * 3]),
        "responses": [np.zeros((part.trajectory.control.size, 8))],
    })  # fmt: skip
    found = locate_root(both)
    assert not isinstance(found, Rejected)
    assert (abs(error_of(found.T_base_root)[2]) > 0.05) == low


def test_what_is_uncertain_of_ranges_is_of_the_height() -> None:
    """Points 0.9 m below, all of them: a range bias moves the floor by as much at right incidence."""
    rng = np.random.default_rng(3)
    root = wander(60.0, rng) @ T_BASE_ROOT
    drive = adjusted_drive(root, floor_points(root, rng))
    exact = locate_root(drive)
    loose = locate_root(Adjustment(**{**vars(drive), "covariance": np.diag([4e-4, 1e-8])}))
    assert not isinstance(exact, Rejected)
    assert not isinstance(loose, Rejected)
    assert loose.covariance[2, 2] > exact.covariance[2, 2] + 1e-6


def test_a_scanner_measures_no_height() -> None:
    flat = wander(60.0, np.random.default_rng(2)) @ se3.pose(
        so3.exp(np.array([0.0, 0.0, 0.7])), T_BASE_ROOT[:3, 3]
    )
    poses = se_n.pose(flat[:, :2, :2], flat[:, :2, 3])
    found = locate_root(adjusted_drive(poses, np.random.default_rng(0).uniform(-5, 5, (500, 2))))
    assert not isinstance(found, Rejected)
    assert np.isnan(np.diag(found.covariance)).tolist() == [False, True, True, True, True, False]
    assert found.T_base_root[0, 3] == pytest.approx(0.6, abs=1e-3)
    assert np.arctan2(found.T_base_root[1, 0], found.T_base_root[0, 0]) == pytest.approx(0.7, abs=1e-3)


def test_a_straight_drive_has_a_heading_but_no_axle() -> None:
    root = wander(60.0, np.random.default_rng(2), turn=0.002) @ T_BASE_ROOT
    found = locate_root(adjusted_drive(root, floor_points(root, np.random.default_rng(0))))
    assert not isinstance(found, Rejected)
    assert np.isnan(found.covariance[0, 0])
    assert found.T_base_root[0, 3] == 0
    assert np.abs(error_of(found.T_base_root)[3:]).max() < 2e-3


def test_a_drive_without_a_floor_has_a_reason() -> None:
    root = wander(60.0, np.random.default_rng(2)) @ T_BASE_ROOT
    found = locate_root(adjusted_drive(root, np.random.default_rng(0).uniform(-5, 5, (500, 3))))
    assert isinstance(found, Rejected)
    assert "no floor was found below the root's path" in found.reason
