"""Trajectories as text files, and messages of poses and turn rates of ROS."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.typesys import Stores, get_typestore

from calgraph.config.settings import LimitSettings
from calgraph.errors import RecordingError
from calgraph.recording import open_recording
from calgraph.recording.decoding import decode
from calgraph.recording.message_types import TypeDefinition, make_message_type
from calgraph.sensors import Message, Pose, TransformList, TurnRate

ROWS = "# time x y z qx qy qz qw\n10.5 1 2 3 0 0 0 1\n10.6 1.5 2 3 0 0 0.6 0.8\n"


@pytest.mark.parametrize(("name", "text"), [("ins.tum", ROWS), ("ins.csv", ROWS.replace(" ", ","))])
def test_a_pose_in_each_line_is_a_recording(tmp_path: Path, name: str, text: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with open_recording(path) as recording:
        poses = [record.decode() for record in recording.records(["ins"])]
    assert [pose.stamp for pose in poses] == [10.5, 10.6]
    assert isinstance(poses[1], Pose)
    assert_allclose(poses[1].position, [1.5, 2, 3])
    assert_allclose(poses[1].quaternion, [0, 0, 0.6, 0.8])


def test_a_line_with_another_number_of_values_is_named(tmp_path: Path) -> None:
    path = tmp_path / "ins.tum"
    path.write_text(ROWS + "10.7 1 2 3\n")
    with pytest.raises(RecordingError, match="line 4 must have 8 numbers, time x y z qx qy qz qw, got 4"):
        open_recording(path)


STORE = get_typestore(Stores.ROS2_HUMBLE)
T = STORE.types


def send(name: str, content: Any) -> Message:
    kind = make_message_type(TypeDefinition(name, MessageDefinitionFormat.NONE, "", "cdr"))
    return decode(kind, bytes(STORE.serialize_cdr(content, name)), 12.5, "here", LimitSettings())


def make_pose() -> Any:
    position = T["geometry_msgs/msg/Point"](x=1.0, y=2.0, z=3.0)
    return T["geometry_msgs/msg/Pose"](
        position=position, orientation=T["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.6, w=0.8)
    )


def header(frame: str) -> Any:
    return T["std_msgs/msg/Header"](
        stamp=T["builtin_interfaces/msg/Time"](sec=12, nanosec=500_000_000), frame_id=frame
    )


def odometry() -> Any:
    zero = T["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    twist = T["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
    return T["nav_msgs/msg/Odometry"](
        header=header("odom"),
        child_frame_id="base",
        pose=T["geometry_msgs/msg/PoseWithCovariance"](pose=make_pose(), covariance=np.zeros(36)),
        twist=T["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
    )


def transform() -> Any:
    moved = T["geometry_msgs/msg/Transform"](
        translation=T["geometry_msgs/msg/Vector3"](x=1.0, y=2.0, z=3.0),
        rotation=T["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.6, w=0.8),
    )
    return T["geometry_msgs/msg/TransformStamped"](header=header("odom"), child_frame_id="base", transform=moved)


def stamped() -> Any:
    return T["geometry_msgs/msg/PoseStamped"](header=header("map"), pose=make_pose())


def with_covariance() -> Any:
    pose = T["geometry_msgs/msg/PoseWithCovariance"](pose=make_pose(), covariance=np.full(36, np.nan))
    return T["geometry_msgs/msg/PoseWithCovarianceStamped"](header=header("map"), pose=pose)


@pytest.mark.parametrize(
    ("name", "content", "frame"),
    [
        ("nav_msgs/msg/Odometry", odometry(), "base"),
        ("geometry_msgs/msg/PoseStamped", stamped(), ""),
        ("geometry_msgs/msg/PoseWithCovarianceStamped", with_covariance(), ""),
        ("geometry_msgs/msg/TransformStamped", transform(), "base"),
    ],
)
def test_messages_with_poses_have_the_frame_that_moves(name: str, content: Any, frame: str) -> None:
    """Headers state the world; covariances, which mean nothing in many programs, are ignored."""
    pose = send(name, content)
    assert isinstance(pose, Pose)
    assert (pose.stamp, pose.frame_id) == (12.5, frame)
    assert_allclose(pose.position, [1, 2, 3])
    assert_allclose(pose.quaternion, [0, 0, 0.6, 0.8])


def test_transforms_of_tf_have_separate_stamps() -> None:
    sent = send("tf2_msgs/msg/TFMessage", T["tf2_msgs/msg/TFMessage"](transforms=[transform()]))
    assert isinstance(sent, TransformList)
    assert sent.parents == ("odom",)
    assert (sent.poses[0].stamp, sent.poses[0].frame_id) == (12.5, "base")
    assert sent.content == "1 transforms"


def test_turn_rates_are_read_without_accelerations() -> None:
    none = np.zeros(9)
    sent = send("sensor_msgs/msg/Imu", T["sensor_msgs/msg/Imu"](
        header=header("imu"), orientation=T["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=0.0),
        orientation_covariance=none, angular_velocity=T["geometry_msgs/msg/Vector3"](x=0.1, y=0.2, z=0.3),
        angular_velocity_covariance=none, linear_acceleration=T["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=9.8),
        linear_acceleration_covariance=none,
    ))  # fmt: skip
    assert isinstance(sent, TurnRate)
    assert sent.frame_id == "imu"
    assert_allclose(sent.rate, [0.1, 0.2, 0.3])
