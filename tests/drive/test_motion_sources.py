"""Trajectories and gyroscopes in a drive: ugly data, what is measured of them, and whole calibrations."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from calgraph.config import Rig
from calgraph.drive.options import DriveOptions
from calgraph.drive.pipeline import calibrate_drive
from calgraph.drive.segments import Segments
from calgraph.drive.sources.trajectory import MotionSource, TrajectoryReader, average_poses
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3, se_n, so3
from calgraph.recording import MessageRecording
from calgraph.result import Calibration
from calgraph.sensors import Message, Pose, TransformList, TurnRate
from calgraph.surfaces.trajectory import Track

T_ROOT_SENSOR = se_n.pose(so3.exp(np.array([0.5, -1.0, 2.0])), np.array([0.4, -0.3, 0.7]))


def path(times: Array, tilt: float = 0.3) -> Array:
    """A smooth path that turns about all axes, or without tilt about the vertical only."""
    height = tilt * np.sin(0.5 * times)
    place = np.stack([3 * np.sin(0.4 * times), 2 * np.sin(0.61 * times), height], axis=1)
    heading = 0.4 * times + 0.9 * np.sin(0.6 * times) + 0.2 * np.sin(1.7 * times)
    turn = np.stack([tilt * np.sin(0.8 * times), tilt * np.sin(1.1 * times + 1), heading], axis=1)
    return se_n.pose(Rotation.from_euler("xyz", turn).as_matrix(), place)


def to_messages(times: Array, poses: Array) -> list[Message]:
    quaternions = so3.quaternion(poses[:, :3, :3])
    return [Pose(float(t), "", T[:3, 3], q) for t, T, q in zip(times, poses, quaternions, strict=True)]


def make_rig(root: str, **kinds: str) -> Rig:
    sensors = {name: {"kind": kind, "topic": f"/{name}"} for name, kind in kinds.items()}
    return Rig.model_validate({"root": root, "target": {"kind": "surroundings"}, "sensors": sensors})


def read_source(messages: list[Message]) -> MotionSource:
    rig = make_rig("a", a="trajectory", b="trajectory")
    reader = TrajectoryReader(rig, "a", 3, np.random.default_rng(0))
    for message in messages:
        reader.add(message)
    source = reader.finish()
    assert isinstance(source, MotionSource)
    return source


def test_unusable_poses_are_left_out() -> None:
    """Unordered and repeated stamps, zeros, NaN, and quaternions that are not of unit length."""
    times: Array = np.arange(200) / 20
    good = to_messages(times, path(times))
    zero = Pose(3.01, "", np.zeros(3), np.zeros(4))
    missing = Pose(4.01, "", np.array([np.nan, 0, 0]), np.array([0.0, 0, 0, 1]))
    first = good[7]
    assert isinstance(first, Pose)
    again = Pose(first.stamp, "", first.position + 5, first.quaternion)
    longer = [Pose(p.stamp, "", p.position, 1.3 * p.quaternion) for p in good if isinstance(p, Pose)]
    segments = read_source([*longer[100:], *longer[:100], zero, missing, again]).segments
    assert isinstance(segments, Segments)
    (track,) = segments.tracks
    assert_allclose(track.times, times)
    assert_allclose(track.poses, path(times), atol=1e-9)


@pytest.mark.parametrize(("jump", "count"), [(0.0, 1), (0.02, 1), (0.15, 2)])
def test_a_jump_splits_the_trajectory(jump: float, count: int) -> None:
    """At 30 Hz, with a millimetre of noise; 2 cm are within what noise and accelerations may be."""
    times: Array = np.arange(600) / 30
    poses = path(times)
    poses[:, :3, 3] += np.random.default_rng(0).normal(0, 0.001, (600, 3))
    poses[300:, 0, 3] += jump
    track = read_source(to_messages(times, poses)).track(np.random.default_rng(0))
    assert isinstance(track, Segments)
    assert len(track.tracks) == count


def test_a_trajectory_of_few_poses_has_a_reason() -> None:
    times: Array = np.arange(20) / 20
    track = read_source(to_messages(times, path(times))).track(np.random.default_rng(0))
    assert track == Rejected("it has 20 usable poses; a drive needs 50")


def test_vibrations_are_averaged_out() -> None:
    """1 cm at 10.5 Hz would look like 0.5 Hz in every third of poses at 30 Hz; 3 mm are left."""
    times: Array = np.arange(900) / 30
    place = np.stack([0.01 * np.sin(2 * np.pi * 10.5 * times), 0 * times, 0 * times], axis=1)
    mean = average_poses(Track(times, se_n.pose(np.eye(3), place)), 0.1)
    assert np.abs(place[::3]).max() > 0.009
    assert np.abs(mean.poses[1:-1, :3, 3]).max() < 0.003
    assert_allclose(mean.times[1:-1], 0.1 * np.arange(1, len(mean.times) - 1), atol=1e-9)


def calibrate(rig: Rig, **messages: list[Message]) -> Calibration:
    recording = MessageRecording({f"/{name}": sent for name, sent in messages.items()})
    return calibrate_drive(rig, recording, DriveOptions())


def drive(seed: int, tilt: float = 0.3) -> tuple[Rig, dict[str, list[Message]]]:
    """Two trajectories and a gyroscope on a rig, with drift, noise, bias and clocks that differ; 15 s."""
    rng = np.random.default_rng(seed)
    times: Array = np.arange(450) / 30
    both = []
    for poses in (path(times, tilt), path(times + 0.15, tilt) @ T_ROOT_SENSOR):
        steps = se_n.inverse(poses[:-1]) @ poses[1:]
        steps = se_n.retract(steps, rng.normal(size=(449, 6)) * np.repeat([2e-4, 1e-4], 3))
        walked = [np.eye(4)]
        for step in steps:
            walked.append(walked[-1] @ step)
        both.append(np.array(walked))
    fine: Array = np.arange(1500) / 100
    turn = se_n.inverse(path(fine - 0.005, tilt)) @ path(fine + 0.005, tilt)
    rates = so3.log(turn[:, :3, :3]) * 100 @ T_ROOT_SENSOR[:3, :3] + [0.01, -0.02, 0.005]
    rates += rng.normal(0, 0.003, rates.shape)
    gyroscope: list[Message] = [
        TurnRate(float(t - 0.08), "imu", rate) for t, rate in zip(fine, rates, strict=True)
    ]
    messages = {"a": to_messages(times, both[0]), "b": to_messages(times, both[1]), "imu": gyroscope}
    return make_rig("a", a="trajectory", b="trajectory", imu="gyroscope"), messages


def test_trajectories_and_a_gyroscope_are_calibrated_without_a_lidar() -> None:
    rig, messages = drive(0)
    calibration = calibrate(rig, **messages)
    b, imu = calibration["b"], calibration["imu"]
    error = se3.difference(b.T_root_sensor, T_ROOT_SENSOR)
    assert np.linalg.norm(error[:3]) < 0.01
    assert np.degrees(np.linalg.norm(error[3:])) < 0.2
    assert error @ np.linalg.solve(b.covariance, error) / 6 < 3
    assert b.clock_offset == pytest.approx(-0.15, abs=0.002)
    assert imu.clock_offset == pytest.approx(-0.08, abs=0.002)
    turned = se3.difference(imu.T_root_sensor, T_ROOT_SENSOR)[3:]
    assert np.degrees(np.linalg.norm(turned)) < 0.4
    assert np.isnan(imu.covariance[:3]).all()
    assert not np.isnan(imu.covariance[3:, 3:]).any()
    assert any("turns do not determine where imu is" in remark for remark in calibration.evidence.remarks)


def test_motion_in_the_plane_leaves_a_height_and_a_turn_unobservable() -> None:
    """Noise of the trajectory would seem to determine them."""
    rig, messages = drive(1, tilt=0.0)
    calibration = calibrate(rig, **messages)
    assert calibration["b"].verdict.grade == "unobservable"
    assert calibration["imu"].verdict.grade == "unobservable"
    assert "not observable from these motions" in calibration["imu"].verdict.reason
    assert np.sqrt(calibration["b"].covariance[2, 2]) > 0.5
    error = se3.difference(calibration["b"].T_root_sensor, T_ROOT_SENSOR)
    assert np.abs(error[:2]).max() < 0.02


def test_a_gyroscope_is_no_root_and_needs_surroundings() -> None:
    with pytest.raises(ValueError, match="must be a sensor with a trajectory, got the gyroscope 'imu'"):
        make_rig("imu", imu="gyroscope", a="trajectory")
    content = {"root": "a", "target": {"kind": "people"}, "sensors": {"a": {"kind": "trajectory", "topic": "/a"}}}
    with pytest.raises(ValueError, match=r"needs target: \{kind: surroundings\}"):
        Rig.model_validate(content)


def test_a_pair_of_frames_of_tf_is_a_trajectory() -> None:
    """Two trajectories of one topic; another pair has the reason with what there is."""
    times: Array = np.arange(200) / 20
    lists: list[Message] = []
    for t, T in zip(times, path(times), strict=True):
        q = so3.quaternion(T[:3, :3])
        poses = (
            Pose(float(t), "base", T[:3, 3], q),
            Pose(float(t), "odom", np.zeros(3), np.array([0.0, 0, 0, 1])),
        )
        lists.append(TransformList(float(t), poses, ("odom", "map")))
    tf = {"kind": "trajectory", "topic": "/tf"}
    sensors = {"a": {**tf, "frame_id": "base", "parent": "odom"}, "b": {**tf, "frame_id": "base", "parent": "map"}}
    rig = Rig.model_validate({"root": "a", "target": {"kind": "surroundings"}, "sensors": sensors})
    for name, usable in (("a", True), ("b", False)):
        reader = TrajectoryReader(rig, name, 3, np.random.default_rng(0))
        for message in lists:
            reader.add(message)
        track = reader.finish().track(np.random.default_rng(0))
        assert isinstance(track, Segments) == usable
        if isinstance(track, Rejected):
            assert "its topic has base in odom, odom in map: state frame_id and parent" in track.reason
