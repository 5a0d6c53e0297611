from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from calgraph.config import load_rig
from calgraph.errors import InputError
from calgraph.geometry import se3
from calgraph.recording import open_recording
from calgraph.sensors import Image, LaserScan, Message, PointCloud
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    build_world,
    ground_truth,
    load_truth,
    simulate_rig,
    world_rig,
)
from calgraph.simulation.motion import BoardPlacement
from calgraph.simulation.robot import MountedScanner
from calgraph.simulation.solids import BoxShape, CylinderShape, Solid
from calgraph.simulation.world import simulate_measurement
from simulated_captures import SimulatedCapture, simulate_background, simulate_captures

SMALL = RigScenario(
    camera=CameraOptions(width=320, height=240, texels_per_mm=0.5),
    laser=LaserOptions(count=2, rate=10, resolution=1.0),
    spinning=SpinningOptions(resolution=1.0, scans_per_degree=1 / 6),
    bearings=(-20, 20),
    radii=(2.0,),
    samples=1,
    background=1.0,
)


def values(message: Message) -> np.ndarray:
    if isinstance(message, Image):
        return message.pixels.ravel()
    if isinstance(message, PointCloud):
        return message.points.ravel()
    assert isinstance(message, LaserScan)
    return message.ranges


def captures(scenario: RigScenario, seed: int = 0) -> list[SimulatedCapture]:
    return list(simulate_captures(build_world(scenario, seed)))


def same(a: Sequence[SimulatedCapture], b: Sequence[SimulatedCapture]) -> list[bool]:
    """For every message of two runs, whether they are equal."""
    return [
        np.array_equal(values(m), values(n), equal_nan=not isinstance(m, Image))
        for x, y in zip(a, b, strict=True)
        for name in x.messages
        for m, n in zip(x.messages[name], y.messages[name], strict=True)
    ]


def test_same_seed_gives_the_same_messages() -> None:
    assert same(captures(SMALL, 4), captures(SMALL, 4)) == 16 * [True]


def test_another_seed_gives_other_messages() -> None:
    assert same(captures(SMALL, 4), captures(SMALL, 5)) == 16 * [False]


def test_measurements_do_not_depend_on_what_else_is_measured() -> None:
    world = build_world(SMALL, 1)
    alone = list(simulate_captures(world, sensors=["laser_left"]))
    for a, b in zip(alone, simulate_captures(world), strict=True):
        for m, n in zip(a.messages["laser_left"], b.messages["laser_left"], strict=True):
            assert np.array_equal(values(m), values(n), equal_nan=True)


def test_every_sensor_measures_twice_in_every_hold() -> None:
    for capture in captures(SMALL.model_copy(update={"samples": 3})):
        assert {name: len(m) for name, m in capture.messages.items()} == dict.fromkeys(capture.messages, 2)


def test_the_usual_spinning_scanner_makes_a_scan_every_three_degrees() -> None:
    """60 scans of 20 ms, the last of 270 degrees of the mirror's turn."""
    (lidar,) = (one for one in build_world(RigScenario(), 0, images=False).robot if one.name == "lidar")
    assert isinstance(lidar, MountedScanner)
    assert lidar.pattern.times[-1] == pytest.approx(59 * 0.02 + 0.75 * 0.02)


def test_measurements_lie_fully_in_their_hold() -> None:
    for capture in simulate_captures(build_world(SMALL, 2), measurements=None):
        for messages in capture.messages.values():
            for m in messages:
                duration = 0.0 if isinstance(m, Image) else m.duration  # type: ignore[union-attr]
                assert capture.board.trigger <= m.stamp <= m.stamp + duration <= capture.board.end


def test_lidar_points_lie_on_the_true_board() -> None:
    exact = SpinningOptions(range_noise=0, angle_noise=0, mixed_pixels=0, dropout=0)
    world = build_world(SMALL.model_copy(update={"spinning": exact}), 0)
    for capture in simulate_captures(world, sensors=["lidar"]):
        (cloud, _) = capture.messages["lidar"]
        assert isinstance(cloud, PointCloud)
        x, y, z = se3.apply(se3.inverse(capture.board.T_root_board), cloud.points).T
        on_sheet = (np.abs(x) < 0.6) & (np.abs(y) < 0.45) & (np.abs(z) < 0.08)
        assert on_sheet.sum() > 50
        # Hands grip the edges, so only the middle of the board is certainly free.
        assert np.abs(z[on_sheet & (np.abs(x) < 0.45)]).max() < 1e-9


def test_laser_points_lie_on_the_true_board() -> None:
    exact = LaserOptions(count=3, range_noise=0, angle_noise=0, mixed_pixels=0, dropout=0)
    world = build_world(SMALL.model_copy(update={"laser": exact}), 0)
    poses = ground_truth(world).T_root_sensor
    for capture in simulate_captures(world, sensors=["laser_front"]):
        scan = capture.messages["laser_front"][0]
        assert isinstance(scan, LaserScan)
        T_board_laser = se3.inverse(capture.board.T_root_board) @ poses["laser_front"]
        x, y, z = se3.apply(T_board_laser, scan.points[scan.valid]).T
        assert ((np.abs(x) < 0.6) & (np.abs(y) < 0.45) & (np.abs(z) < 1e-9)).sum() > 60


def test_multibeam_lidar_reports_the_ring_and_time_of_every_point() -> None:
    spinning, multibeam = SpinningOptions(count=0), MultibeamOptions(count=1, rings=16, resolution=1.0)
    world = build_world(SMALL.model_copy(update={"spinning": spinning, "multibeam": multibeam}), 0)
    capture = next(simulate_captures(world, sensors=["lidar"]))
    cloud = capture.messages["lidar"][0]
    assert isinstance(cloud, PointCloud)
    assert cloud.rings is not None
    assert cloud.times is not None
    assert set(cloud.rings.tolist()) == set(range(16))
    assert 0.09 < cloud.times[-1] < 0.1


def test_background_is_measured_without_the_board() -> None:
    world = build_world(SMALL, 0)
    for name, messages in simulate_background(world).items():
        assert messages, name
        assert messages[-1].stamp < SMALL.start_time + SMALL.background


def test_disturbed_captures_have_the_stated_fraction_and_are_marked() -> None:
    world = build_world(SMALL.model_copy(update={"samples": 10, "disturbed": 0.2}), 0)
    assert sum(b.disturbed for b in ground_truth(world).boards) == 4


def test_mounts_differ_from_seed_to_seed_by_centimetres_and_degrees() -> None:
    poses = [ground_truth(build_world(SMALL, seed)).T_root_sensor["camera"] for seed in range(2)]
    error = se3.difference(poses[0], poses[1])
    assert 0.01 < np.linalg.norm(error[:3]) < 0.8
    assert 0.5 < np.degrees(np.linalg.norm(error[3:])) < 25


def test_robot_can_have_any_number_of_sensors() -> None:
    rig = world_rig(
        build_world(
            RigScenario(
                camera=CameraOptions(count=2, width=64, height=48, texels_per_mm=0.1),
                laser=LaserOptions(count=5),
                spinning=SpinningOptions(count=0),
                multibeam=MultibeamOptions(count=2),
            ),
            0,
        )
    )
    assert list(rig.sensors) == [
        "camera", "camera_2", "lidar", "lidar_2",
        "laser_front", "laser_left", "laser_right", "laser_back", "laser_5",
    ]  # fmt: skip


def test_unknown_root_is_named() -> None:
    with pytest.raises(InputError, match="root 'imu' is not a sensor of this robot; it has camera, lidar"):
        build_world(SMALL.model_copy(update={"root": "imu"}), 0)


def test_recording_comes_with_rig_and_truth(tmp_path: Path) -> None:
    steps: list[tuple[int, int]] = []
    simulate_rig(SMALL, tmp_path, seed=3, progress=lambda done, total: steps.append((done, total)))
    world = build_world(SMALL, 3)
    assert load_rig(tmp_path / "rig.yaml") == world_rig(world)
    assert "settings" not in (tmp_path / "rig.yaml").read_text()
    truth = load_truth(tmp_path / "truth.yaml")
    for name, T in ground_truth(world).T_root_sensor.items():
        assert truth.T_root_sensor[name] == pytest.approx(T, abs=1e-12)
    assert [b.trigger for b in truth.boards] == [b.trigger for b in ground_truth(world).boards]
    assert steps[-1] == (len(steps), len(steps))


def test_recording_has_every_topic_and_a_trigger_for_each_capture(tmp_path: Path) -> None:
    simulate_rig(SMALL, tmp_path)
    with Reader(tmp_path / "recording") as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    assert counts["/trigger"] == 2
    assert counts["/camera/image_raw/compressed"] == counts["/camera/camera_info"] > 10
    assert counts.keys() >= {"/lidar/points", "/laser_front/scan", "/laser_left/scan"}


def test_without_trigger_the_rig_has_no_trigger_topic(tmp_path: Path) -> None:
    simulate_rig(SMALL.model_copy(update={"trigger": False}), tmp_path)
    assert load_rig(tmp_path / "rig.yaml").capture.trigger is None
    with Reader(tmp_path / "recording") as reader:
        assert "/trigger" not in {c.topic for c in reader.connections}


def test_holds_end_a_tenth_of_a_second_after_the_second_measurement_of_the_slowest_sensor() -> None:
    world = build_world(SMALL, 3)
    for hold in world.trajectory.holds:
        clocks = [sensor.clock for sensor in world.robot]
        ends = [clock.start(clock.first_after(hold.start) + 1) + clock.duration for clock in clocks]
        assert hold.end == pytest.approx(max(ends) + 0.1)


def test_clutter_leaves_room_for_the_operator_behind_the_farthest_board() -> None:
    world = build_world(SMALL.model_copy(update={"clutter": 40}), 3)
    for solid in world.solids_at(None)[1:]:
        shape = solid.shape
        assert isinstance(shape, BoxShape | CylinderShape)
        extent = shape.radius if isinstance(shape, CylinderShape) else np.hypot(shape.length, shape.width) / 2
        assert 3.3 - 1e-9 <= np.linalg.norm(solid.T_world_shape[:2, 3]) - extent <= 4.3


def test_beams_of_a_moving_board_are_cast_in_steps_of_20_milliseconds() -> None:
    world, states = build_world(SMALL, 3), set[float]()

    def solids_at(placement: BoardPlacement | None) -> tuple[Solid, ...]:
        if placement is not None:
            states.add(placement.bearing)
        return world.solids_at(placement)

    lidar = next(sensor for sensor in world.robot if sensor.kind == "lidar3d")
    start, end = world.trajectory.holds[0].end, world.trajectory.holds[1].start
    index = lidar.clock.first_after(start - 0.5 * lidar.clock.duration)
    simulate_measurement(replace(world, solids_at=solids_at), lidar, index)
    covered = min(end, lidar.clock.start(index) + lidar.clock.duration) - max(start, lidar.clock.start(index))
    assert len(states) == pytest.approx(covered / 0.02, abs=3)


@pytest.mark.parametrize("sensor", ["lidar", "laser_left", "camera"])
def test_messages_arrive_2_to_20_milliseconds_after_their_end(tmp_path: Path, sensor: str) -> None:
    simulate_rig(SMALL, tmp_path)
    clock = next(one.clock for one in build_world(SMALL, 0).robot if one.name == sensor)
    topics = {"lidar": "/lidar/points", "laser_left": "/laser_left/scan", "camera": "/camera/image_raw/compressed"}
    with open_recording(tmp_path / "recording") as recording:
        delays = [r.arrival - r.stamp - clock.duration for r in recording.records(topics=[topics[sensor]])]
    assert 0.0019 < min(delays) < max(delays) < 0.0201
