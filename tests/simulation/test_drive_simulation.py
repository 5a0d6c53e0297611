"""Simulated drives: points lie on the surfaces of the world at the true poses and times; faults are as stated."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calgraph.errors import InputError
from calgraph.geometry import Array, se3, so3
from calgraph.sensors import LaserScan, PointCloud, Pose, TurnRate
from calgraph.simulation import load_truth
from calgraph.simulation.drive_recording import record_drive
from calgraph.simulation.drive_scenario import EXACT, STANDARD_RIGS, DriveFaults, DriveScenario, RigName
from calgraph.simulation.drive_simulation import DriveTruth, SimulatedDrive, simulate_drive
from calgraph.simulation.drive_world import LAYOUTS, WorldKind
from calgraph.simulation.solids import (
    BoxShape,
    CylinderShape,
    FrustumShape,
    ReliefShape,
    Shape,
    SphereShape,
    Surface,
)

SHORT = DriveScenario(seed=2, duration=4.0, people=0, cars=0, stamp_jitter=0.0)
EXACT_DRIVE = replace(SHORT, world="hall", errors=EXACT)
ALL_KINDS = (*STANDARD_RIGS["lidar_and_solid_state"], STANDARD_RIGS["lidar_and_scanner"][1])


def distance_to(shape: Shape, points: Array) -> Array:
    """(N,) distances of points (N, 3) from a shape, from formulas that the ray casting does not use."""
    x, y, z = points.T
    if isinstance(shape, SphereShape):
        return np.asarray(np.abs(np.linalg.norm(points, axis=1) - shape.radius))
    if isinstance(shape, BoxShape | CylinderShape):
        if isinstance(shape, BoxShape):
            beyond = np.abs(points) - 0.5 * np.array([shape.length, shape.width, shape.height])
        else:
            beyond = np.stack([np.hypot(x, y) - shape.radius, np.abs(z) - shape.height / 2], axis=-1)
        outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
        return np.asarray(np.abs(outside + np.minimum(beyond.max(axis=1), 0)))
    if isinstance(shape, FrustumShape):
        half, foot = np.array(shape.top) / 2, np.array(shape.top) / 2 + shape.runs
        ramp = shape.height * ((foot - np.abs(points[:, :2])) / (foot - half)).min(axis=1)
        return np.where(ramp < -1e-6, np.inf, np.abs(z - np.clip(ramp, 0, shape.height)))
    beyond = np.maximum(np.abs(points[:, :2]) - [shape.width / 2, shape.height / 2], 0).max(axis=1)
    waves = 0.0 * z
    if isinstance(shape, ReliefShape):
        for amplitude, vector, phase in zip(shape.amplitudes, shape.wave_vectors, shape.phases, strict=True):
            waves = waves + amplitude * np.sin(vector[0] * x + vector[1] * y + phase)
    return np.asarray(np.abs(z - waves) + beyond)


def distance_to_surfaces(surfaces: tuple[Surface, ...], points: Array) -> Array:
    """(N,) distances of points (N, 3) from the nearest of the surfaces."""
    nearest = np.full(len(points), np.inf)
    for surface in surfaces:
        local = (points - surface.T_world_shape[:3, 3]) @ surface.T_world_shape[:3, :3]
        nearest = np.minimum(nearest, distance_to(surface.shape, local))
    return nearest


def root_poses(truth: DriveTruth, stamps: Array) -> Array:
    """(N, 4, 4) from the stated trajectory, at constant velocities between its samples."""
    index = np.clip(np.searchsorted(truth.times, stamps, side="right") - 1, 0, len(truth.times) - 2)
    part = ((stamps - truth.times[index]) / np.diff(truth.times)[index])[:, None]
    T0, T1 = truth.T_world_root[index], truth.T_world_root[index + 1]
    R0, R1 = T0[:, :3, :3], T1[:, :3, :3]
    R = R0 @ so3.exp(part * so3.log(np.swapaxes(R0, 1, 2) @ R1))
    return se3.pose(R, (1 - part) * T0[:, :3, 3] + part * T1[:, :3, 3])


def measured_points(drive: SimulatedDrive, name: str) -> tuple[Array, Array]:
    """Points (N, 3) of a sensor in its frame, and their stamps (N,) in its clock."""
    points, stamps = [], []
    for record in drive.recording.records():
        message = record.decode()
        if message.frame_id != name:
            continue
        if isinstance(message, LaserScan):
            points.append(message.points[message.valid])
            stamps.append(message.stamp + message.time_increment * np.flatnonzero(message.valid))
        else:
            assert isinstance(message, PointCloud)
            assert message.times is not None
            points.append(message.points)
            stamps.append(message.stamp + message.times)
    return np.concatenate(points), np.concatenate(stamps)


def distances_from_world(
    drive: SimulatedDrive, name: str, T_root_sensor: Array, offset: float
) -> tuple[Array, Array, Array]:
    """Distances (N,) of points from what stands still and from all surfaces, and stamps in the root's clock."""
    points, stamps = measured_points(drive, name)
    stamps = stamps - offset
    kept = (stamps > drive.truth.times[0]) & (stamps < drive.truth.times[-1])
    T_world_sensor = root_poses(drive.truth, stamps[kept]) @ T_root_sensor
    in_world = np.einsum("nij,nj->ni", T_world_sensor[:, :3, :3], points[kept]) + T_world_sensor[:, :3, 3]
    still = distance_to_surfaces(drive.truth.world.surfaces, in_world)
    nearest = still
    for body in drive.truth.world.bodies:
        T_world_body = body.poses(stamps[kept] - drive.scenario.start_time)
        in_body = np.einsum("nji,nj->ni", T_world_body[:, :3, :3], in_world - T_world_body[:, :3, 3])
        nearest = np.minimum(nearest, distance_to_surfaces(body.surfaces, in_body))
    return still, nearest, stamps[kept]


@pytest.mark.parametrize("world", LAYOUTS)
def test_points_of_an_exact_drive_lie_on_the_surfaces_of_the_world(world: WorldKind) -> None:
    scenario = replace(SHORT, world=world, errors=EXACT, sensors=ALL_KINDS, max_clock_offset=0.3, people=3, cars=2)
    drive = simulate_drive(scenario)
    truth = drive.truth
    # In an open field other tilted sensors may measure the sky.
    for sensor in ALL_KINDS[: 1 if world == "field" else 3]:
        T, offset = truth.T_root_sensor[sensor.name], truth.clock_offsets[sensor.name]
        _, off, _ = distances_from_world(drive, sensor.name, T, offset)
        assert len(off) > 1000
        # Between samples of the trajectory, vibrations of 13 Hz move a point at 40 m by tenths of a millimetre.
        assert np.quantile(off, 0.999) < 1e-3
        assert off.max() < 3e-3


def test_beams_end_at_the_first_surface() -> None:
    drive = simulate_drive(replace(EXACT_DRIVE, world="yard", duration=1.0, glass=0))
    points, stamps = measured_points(drive, "lidar_rear")
    points, stamps = points[::7], stamps[::7] - drive.truth.clock_offsets["lidar_rear"]
    T_world_sensor = root_poses(drive.truth, stamps) @ drive.truth.T_root_sensor["lidar_rear"]
    ranges = np.linalg.norm(points, axis=1)
    directions = np.einsum("nij,nj->in", T_world_sensor[:, :3, :3], points / ranges[:, None])
    first = np.full(len(points), np.inf)
    for surface in drive.truth.world.surfaces:
        R, t = surface.T_world_shape[:3, :3], surface.T_world_shape[:3, 3]
        first = np.minimum(first, surface.shape.distance(R.T @ (T_world_sensor[:, :3, 3] - t).T, R.T @ directions))
    # A beam that just passes an edge may hit it when it is cast from an interpolated place.
    assert np.mean(np.abs(first - ranges) < 0.01) > 0.995


def test_points_leave_the_surfaces_with_another_pose_or_clock() -> None:
    drive = simulate_drive(EXACT_DRIVE)
    T, offset = drive.truth.T_root_sensor["lidar_rear"], drive.truth.clock_offsets["lidar_rear"]
    moved = se3.retract(T, np.array([0.02, 0, 0, 0, 0, 0]))
    turned = se3.retract(T, np.array([0, 0, 0, 0, 0, 0.005]))
    for other, clock in ((moved, offset), (turned, offset), (T, offset + 0.02)):
        assert np.quantile(distances_from_world(drive, "lidar_rear", other, clock)[1], 0.9) > 2e-3


def test_errors_of_ranges_are_of_the_stated_size() -> None:
    drive = simulate_drive(replace(EXACT_DRIVE, errors=replace(EXACT, noise=0.01, bias=0.02, quantum=0.002)))
    for name in ("lidar_front", "lidar_rear"):
        T, offset = drive.truth.T_root_sensor[name], drive.truth.clock_offsets[name]
        assert 0.003 < np.median(distances_from_world(drive, name, T, offset)[1]) < 0.06
    ranges = np.linalg.norm(measured_points(drive, "lidar_rear")[0], axis=1) / 0.002
    assert np.abs(ranges - np.round(ranges)).max() < 1e-3


def stated(drive: SimulatedDrive, name: str) -> tuple[Array, Array]:
    """Stamps (N,), and poses (N, 4, 4) or turn rates (N, 3) of a sensor."""
    messages = drive.messages[drive.topics[name]]
    values = [
        se3.from_xyz_quaternion(one.position, one.quaternion) if isinstance(one, Pose) else one.rate
        for one in messages
        if isinstance(one, Pose | TurnRate)
    ]
    return np.array([one.stamp for one in messages]), np.array(values)


def test_drives_depend_on_the_seed_alone() -> None:
    first, again, other = (
        simulate_drive(replace(SHORT, duration=2.0, seed=seed, sensors=STANDARD_RIGS["mixed"]))
        for seed in (4, 4, 5)
    )
    points = [measured_points(drive, "lidar_rear")[0] for drive in (first, again, other)]
    assert np.array_equal(points[0], points[1])
    assert not np.array_equal(points[0][:100], points[2][:100])
    for name in ("odometry", "gyroscope"):
        assert np.array_equal(stated(first, name)[1], stated(again, name)[1])


def test_errors_do_not_change_the_drive() -> None:
    noisy, exact = (simulate_drive(replace(SHORT, duration=2.0, errors=e)) for e in (SHORT.errors, EXACT))
    assert np.array_equal(noisy.truth.T_world_root, exact.truth.T_world_root)
    assert np.array_equal(noisy.truth.T_root_sensor["lidar_rear"], exact.truth.T_root_sensor["lidar_rear"])


@pytest.mark.parametrize("rig", ["two_lidars", "three_lidars", "four_lidars", "lidar_and_solid_state"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_sensors_of_standard_rigs_share_no_view(rig: RigName, seed: int) -> None:
    drive = simulate_drive(replace(EXACT_DRIVE, seed=seed, duration=1.0, sensors=STANDARD_RIGS[rig]))
    poses = drive.truth.T_root_sensor
    points = {name: measured_points(drive, name)[0] for name in poses}
    for name, measured in points.items():
        for other in points.keys() - {name}:
            local = se3.apply(se3.inverse(poses[other]) @ poses[name], measured[::17])
            beams = points[other][::3] / np.linalg.norm(points[other][::3], axis=1, keepdims=True)
            cosine = (local @ beams.T).max(axis=1) / np.linalg.norm(local, axis=1)
            assert np.degrees(np.arccos(np.minimum(cosine, 1.0))).min() > 0.5


def test_fields_that_are_too_wide_are_refused() -> None:
    wide = tuple(replace(sensor, sector=300.0) for sensor in STANDARD_RIGS["two_lidars"])
    with pytest.raises(InputError, match="lidar_rear: its field overlaps"):
        simulate_drive(replace(SHORT, sensors=wide))
    simulate_drive(replace(SHORT, sensors=wide, duration=2.0, no_shared_view=False))


def test_bumped_sensor_has_another_pose_from_then_on() -> None:
    drive = simulate_drive(replace(EXACT_DRIVE, faults=DriveFaults(bump=(0.05, 2.0))))
    truth = drive.truth
    before, after = truth.T_root_sensor["lidar_rear"], truth.T_root_sensor_after["lidar_rear"]
    offset = truth.clock_offsets["lidar_rear"]
    assert np.linalg.norm(after[:3, 3] - before[:3, 3]) == pytest.approx(0.05)
    assert np.linalg.norm(so3.log(after[:3, :3] @ before[:3, :3].T)) == pytest.approx(np.radians(2.0))
    off_before, _, stamps = distances_from_world(drive, "lidar_rear", before, offset)
    off_after, _, _ = distances_from_world(drive, "lidar_rear", after, offset)
    late = stamps > truth.times[0] + 2.0
    assert max(np.quantile(off_before[~late], 0.99), np.quantile(off_after[late], 0.99)) < 1e-3
    assert min(np.median(off_before[late]), np.median(off_after[~late])) > 5e-3


def test_clocks_and_ranges_are_wrong_as_stated() -> None:
    right = simulate_drive(EXACT_DRIVE)
    faults = DriveFaults(clock_drift=1e-3, clock_jump=0.1, range_scale=0.01)
    wrong = simulate_drive(replace(EXACT_DRIVE, faults=faults))
    points, stamps = zip(*(measured_points(drive, "lidar_rear") for drive in (right, wrong)), strict=True)
    # Beams beyond the range are lost before the error.
    assert np.allclose(points[1], 1.01 * points[0])
    gap = stamps[1] - stamps[0]
    late = stamps[0] > right.truth.times[0] + 2.1
    assert gap[late].min() > 0.1
    assert np.ptp(gap[late]) == pytest.approx(1e-3 * np.ptp(stamps[0][late]), abs=1e-5)
    front = [measured_points(drive, "lidar_front")[1] for drive in (right, wrong)]
    assert np.array_equal(front[0], front[1])


def test_truth_yaml_holds_the_faults(tmp_path: Path) -> None:
    scenario = replace(SHORT, duration=2.0, faults=DriveFaults(clock_jump=0.1, bump=(0.05, 2.0)))
    record_drive(scenario, tmp_path, lambda *_: None)
    expected = {"lidar_rear": {"clock_jump": 0.1, "bump": [0.05, 2.0], "time": 1.0}}
    assert load_truth(tmp_path / "truth.yaml").errors == expected


def test_truck_covers_a_part_of_the_view() -> None:
    shares = []
    for seed in range(3):
        scenario = replace(EXACT_DRIVE, seed=seed, world="yard", sensors=STANDARD_RIGS["four_lidars"])
        drive = simulate_drive(replace(scenario, faults=DriveFaults(truck=True)))
        for name, T in drive.truth.T_root_sensor.items():
            still, nearest, _ = distances_from_world(drive, name, T, drive.truth.clock_offsets[name])
            assert np.quantile(nearest, 0.999) < 1e-3
            shares.append(np.mean(still > 0.05))
    assert 0.2 < np.mean(shares) < 0.6


def test_other_programs_and_gyroscopes_follow_the_motion() -> None:
    scenario = replace(SHORT, duration=20.0, path="planar", sensors=STANDARD_RIGS["mixed"][1:])
    drive = simulate_drive(replace(scenario, sensors=tuple(replace(s, step=20.0) for s in scenario.sensors)))
    truth = drive.truth
    for name, moved_by, turned_by in (("odometry", 0.05, 0.03), ("trajectory", 0.02, 0.01)):
        stamps, poses = stated(drive, name)
        stamps = stamps - truth.clock_offsets[name]
        kept = (stamps > truth.times[0]) & (stamps < truth.times[-1])
        true = root_poses(truth, stamps[kept]) @ truth.T_root_sensor[name]
        steps = [se3.inverse(T[:-100]) @ T[100:] for T in (poses[kept], true)]
        error = se3.difference(*steps)
        way = np.abs(steps[1][:, :3, 3]).max()
        assert way > 0.5
        assert 0 < np.abs(error[:, :3]).max() < moved_by * way + 0.01
        assert np.abs(error[:, 3:]).max() < turned_by + 0.03 * np.abs(so3.log(steps[1][:, :3, :3])).max()
    stamps, rates = stated(drive, "gyroscope")
    stamps = stamps - truth.clock_offsets["gyroscope"]
    inner = (stamps > truth.times[0]) & (stamps < truth.times[-1])
    R = (root_poses(truth, stamps[inner]) @ truth.T_root_sensor["gyroscope"])[:, :3, :3]
    from_poses = so3.log(np.swapaxes(R[:-2], 1, 2) @ R[2:]) / (stamps[inner][2:] - stamps[inner][:-2])[:, None]
    assert np.std(from_poses, axis=0).max() > 0.1
    assert np.abs(rates[inner][1:-1] - from_poses).max() < 0.03
