"""Types that are not read are named, and so are lengths in millimetres, before a recording is read at length."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from calgraph.config import Rig, draft_rig
from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.recording import MessageRecording, find_topics, inspect_recording, open_recording
from calgraph.recording.sensor_topics import check_sensor_topics, explain_unread
from calgraph.sensors import Image, LaserScan, Message, PointCloud

MakeBag = Callable[..., Path]


def rig(**topics: str) -> Rig:
    kinds = {"laser": "lidar2d", "lidar": "lidar3d", "camera": "camera"}
    sensors = {name: {"kind": kinds[name], "topic": topic} for name, topic in topics.items()}
    target = {"kind": "board", "size": [1, 1], "family": "tag36h11", "tags": [{"id": 1, "size": 0.5}]}
    return Rig.model_validate({"root": next(iter(topics)), "target": target, "sensors": sensors})


def cloud(scale: float, count: int = 200) -> PointCloud:
    directions = np.random.default_rng(0).normal(size=(count, 3))
    ranges = np.linspace(0.4, 30, count)[:, None]
    return PointCloud(1.0, "lidar", scale * ranges * directions / np.linalg.norm(directions, axis=1)[:, None])


def scan(scale: float, ranges: Array | None = None) -> LaserScan:
    measured = np.linspace(0.3, 8, 200) if ranges is None else ranges
    return LaserScan(1.0, "laser", np.linspace(-1, 1, len(measured)), scale * measured)


def recording(**messages: Message) -> MessageRecording:
    return MessageRecording({topic: [message] * 5 for topic, message in messages.items()})


@pytest.mark.parametrize(("name", "message"), [("lidar", cloud(1000)), ("laser", scan(1000))])
def test_millimetres_are_named(name: str, message: Message) -> None:
    with pytest.raises(InputError, match=rf"sensors\.{name}: a: half of its points .* in millimetres"):
        check_sensor_topics(rig(**{name: "a"}), recording(a=message))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("lidar", cloud(1)),
        ("lidar", cloud(10)),  # to 300 m
        ("laser", scan(1)),
        ("laser", scan(1, np.full(50, np.nan))),
        ("lidar", PointCloud(1.0, "", np.zeros((0, 3)))),
        ("camera", Image(1.0, "", np.full((4, 4), 255, np.uint8))),
    ],
)
def test_metres_are_not(name: str, message: Message) -> None:
    check_sensor_topics(rig(**{name: "a"}), recording(a=message))


def test_one_message_in_metres_suffices() -> None:
    messages = [PointCloud(1.0 + k, "", cloud(1 if k == 2 else 1000).points) for k in range(5)]
    check_sensor_topics(rig(lidar="a"), MessageRecording({"a": messages}))


def test_millimetres_in_a_bag_are_named_although_the_limits_of_the_scan_are_metres(
    ros: SimpleNamespace, make_bag: MakeBag
) -> None:
    scans = [ros.scan(header=ros.header(k), ranges=np.linspace(400, 7000, 50, dtype=np.float32)) for k in (1, 2)]
    path = make_bag(*(("/scan", one, 1.0) for one in scans))
    with open_recording(path) as opened:
        with pytest.raises(InputError, match=r"sensors\.laser: /scan: half of its points .* millimetres"):
            check_sensor_topics(rig(laser="/scan"), opened)
        (topic,) = find_topics(opened)
        (report,) = inspect_recording(opened, lambda _: None).topics
    assert "in millimetres" in topic.problem
    assert any("in millimetres" in finding for finding in report.findings)


@pytest.mark.parametrize("beyond", [9.0, 65.535, np.inf])
def test_beams_without_a_return_are_no_millimetres(ros: SimpleNamespace, make_bag: MakeBag, beyond: float) -> None:
    path = make_bag(("/scan", ros.scan(ranges=np.full(50, beyond, np.float32)), 1.0))
    with open_recording(path) as opened:
        check_sensor_topics(rig(laser="/scan"), opened)
        message = next(opened.records()).decode()
    assert isinstance(message, LaserScan)
    assert message.is_empty


def test_a_type_that_is_not_read_is_named(ros: SimpleNamespace, make_bag: MakeBag) -> None:
    message = ros.types["sensor_msgs/msg/Temperature"](ros.header(), 20.0, 1.0)
    path = make_bag(("/lidar_packets", message, 1.0), ("/scan", ros.scan(), 1.0))
    with open_recording(path) as opened:
        with pytest.raises(InputError, match=r"sensors\.lidar: /lidar_packets: its messages of type sensor_"):
            check_sensor_topics(rig(lidar="/lidar_packets"), opened)
        draft = draft_rig(find_topics(opened), "bag")
    assert "#   /lidar_packets: its messages of type sensor_msgs/msg/Temperature are not read" in draft


@pytest.mark.parametrize(
    ("topic_type", "advice"),
    [
        ("ouster_sensor_msgs/msg/PacketMsg", "replay the recording through its driver"),
        ("rslidar_msgs/msg/rslidarScan", "replay the recording through its driver"),
        ("hesai_ros_driver/msg/UdpFrame", "replay the recording through its driver"),
        ("theora_image_transport/msg/Packet", "republish it with `ros2 run image_transport republish`"),
        ("foxglove.CompressedPointCloud", "point_cloud_transport"),
        ("point_cloud_interfaces/msg/CompressedPointCloud2", "point_cloud_transport"),
        ("stereo_msgs/msg/DisparityImage", "record the depth image"),
    ],
)
def test_known_types_have_the_way_to_convert_them(topic_type: str, advice: str) -> None:
    assert f"its messages of type {topic_type} are not read: " in explain_unread(topic_type)
    assert advice in explain_unread(topic_type)
