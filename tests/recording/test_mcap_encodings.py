"""MCAPs that are not of ROS 2: Foxglove's messages as its own library encodes them, JSON, and ROS 1."""

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import foxglove.messages as fox
import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from calgraph.errors import RecordingError
from calgraph.recording import find_topics, inspect_recording, open_recording
from calgraph.sensors import CameraInfo, Image, LaserScan, Message, PointCloud

Content = tuple[str, str, str, bytes, bytes]
"""Topic, type, encoding, schema and bytes of a message."""
STAMP = fox.Timestamp(12, 500_000_000)
_SCHEMA_ENCODINGS = {"cdr": "ros2msg", "protobuf": "protobuf", "json": "jsonschema", "ros1": "ros1msg"}


def write_mcap(
    path: Path, messages: Sequence[Content], profile: str = "", compression: CompressionType = CompressionType.NONE
) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start(profile, library="")
        for number, (topic, name, encoding, schema, data) in enumerate(messages):
            schema_id = writer.register_schema(name, _SCHEMA_ENCODINGS.get(encoding, encoding), schema)
            channel = writer.register_channel(topic, encoding, schema_id)
            writer.add_message(channel, (20 + number) * 10**9, data, (20 + number) * 10**9)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def protobuf(topic: str, message: Any) -> Content:
    schema = type(message).get_schema()
    return topic, schema.name, "protobuf", schema.data, message.encode()


def as_json(topic: str, name: str, **fields: Any) -> Content:
    content = {"timestamp": {"sec": 12, "nsec": 500_000_000}, "frame_id": "sensor", **fields}
    return topic, f"foxglove.{name}", "json", b"{}", json.dumps(content).encode()


def read(path: Path) -> list[Message]:
    with open_recording(path) as recording:
        return [record.decode() for record in recording.records()]


def cloud_fields() -> list[Any]:
    kind = fox.PackedElementFieldNumericType
    return [
        fox.PackedElementField(name=name, offset=offset, type=type)
        for name, offset, type in (
            ("x", 0, kind.Float32), ("y", 4, kind.Float32), ("z", 8, kind.Float32), ("ring", 12, kind.Uint16),
            ("t", 16, kind.Uint32),
        )
    ]  # fmt: skip


POINTS = np.array(
    [(1, 2, 3, 5, 0), (4, -5, 6, 7, 50_000_000), (0, 0, 0, 1, 0)],
    np.dtype({
        "names": ["x", "y", "z", "ring", "t"], "formats": ["<f4", "<f4", "<f4", "<u2", "<u4"],
        "offsets": [0, 4, 8, 12, 16], "itemsize": 20,
    }),
)  # fmt: skip
PIXELS = np.arange(24, dtype=np.uint8).reshape(4, 6)
K = [500.0, 0, 320, 0, 510, 240, 0, 0, 1]
PNG = cv2.imencode(".png", PIXELS)[1].tobytes()


def protobuf_cloud(**fields: Any) -> Content:
    given = {"frame_id": "lidar", "point_stride": 20, "fields": cloud_fields(), "data": POINTS.tobytes(), **fields}
    return protobuf("/points", fox.PointCloud(timestamp=STAMP, **given))


def json_cloud() -> Content:
    names = [(name, offset, 7) for name, offset in (("x", 0), ("y", 4), ("z", 8))] + [
        ("ring", 12, 3),
        ("t", 16, 5),
    ]
    fields = [{"name": name, "offset": offset, "type": kind} for name, offset, kind in names]
    data = base64.b64encode(POINTS.tobytes()).decode()
    return as_json("/points", "PointCloud", point_stride=20, fields=fields, data=data)


@pytest.mark.parametrize("message", [protobuf_cloud(), json_cloud()], ids=["protobuf", "json"])
def test_foxglove_clouds_have_points_rings_and_times(tmp_path: Path, message: Content) -> None:
    (cloud,) = read(write_mcap(tmp_path / "a.mcap", [message]))
    assert isinstance(cloud, PointCloud)
    assert cloud.stamp == 12.5
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, -5, 6]])
    np.testing.assert_array_equal(cloud.rings, [5, 7])
    assert cloud.times is not None
    np.testing.assert_allclose(cloud.times, [0, 0.05])


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
def test_foxglove_images_and_intrinsics_are_read(tmp_path: Path, compression: CompressionType) -> None:
    messages = [
        protobuf("/c", fox.CompressedImage(timestamp=STAMP, frame_id="cam", data=PNG, format="png")),
        protobuf(
            "/r",
            fox.RawImage(
                timestamp=STAMP, frame_id="cam", width=6, height=4, encoding="mono8", step=6, data=PIXELS.tobytes()
            ),
        ),
        protobuf(
            "/k",
            fox.CameraCalibration(
                timestamp=STAMP, frame_id="cam", width=640, height=480, distortion_model="plumb_bob",
                D=[0.1, -0.2, 0, 0, 0], K=K,
            ),
        ),
        as_json("/jc", "CompressedImage", data=base64.b64encode(PNG).decode(), format="png"),
        as_json("/jk", "CameraCalibration", width=640, height=480, distortion_model="", D=[], K=K),
    ]  # fmt: skip
    compressed, raw, info, other, undistorted = read(write_mcap(tmp_path / "a.mcap", messages, "", compression))
    for image in (compressed, raw, other):
        assert isinstance(image, Image)
        np.testing.assert_array_equal(image.pixels, PIXELS)
    assert isinstance(info, CameraInfo)
    assert info.frame_id == "cam"
    np.testing.assert_allclose(info.camera.distortion, [0.1, -0.2, 0, 0, 0])
    assert isinstance(undistorted, CameraInfo)
    np.testing.assert_allclose(undistorted.camera.K.ravel(), K)


def test_foxglove_scans_spread_their_beams_between_both_angles(tmp_path: Path) -> None:
    messages = [
        protobuf(
            "/s", fox.LaserScan(timestamp=STAMP, frame_id="l", start_angle=-1, end_angle=1, ranges=[1, 0, 3])
        ),
        as_json("/j", "LaserScan", start_angle=-1, end_angle=1, ranges=[1, None, 3]),
    ]
    for scan in read(write_mcap(tmp_path / "a.mcap", messages)):
        assert isinstance(scan, LaserScan)
        np.testing.assert_allclose(scan.angles, [-1, 0, 1])
        np.testing.assert_array_equal(scan.ranges, [1, np.nan, 3])


def test_a_pose_within_the_frame_leaves_the_clouds_frame_without_a_name(tmp_path: Path) -> None:
    level = fox.Quaternion(x=0, y=0, z=0, w=1)
    poses = [fox.Pose(position=fox.Vector3(x=0, y=0, z=z), orientation=level) for z in (0.0, 1.5)]
    files = [write_mcap(tmp_path / f"{i}.mcap", [protobuf_cloud(pose=pose)]) for i, pose in enumerate(poses)]
    assert [message.frame_id for file in files for message in read(file)] == ["lidar", ""]


_ROS_SCHEMA = """builtin_interfaces/Time timestamp
string frame_id
uint8[] data
string format
"""


def test_foxglove_messages_of_ros_are_read(tmp_path: Path) -> None:
    name = "foxglove_msgs/msg/CompressedImage"
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(_ROS_SCHEMA, name))
    time = store.types["builtin_interfaces/msg/Time"](12, 500_000_000)
    message = store.types[name](time, "cam", np.frombuffer(PNG, np.uint8), "png")
    schema = store.generate_msgdef(name, ros_version=2)[0].encode()
    content = ("/c", name, "cdr", schema, bytes(store.serialize_cdr(message, name)))
    path = write_mcap(tmp_path / "a.mcap", [content], "ros2")
    with open_recording(path) as recording:
        (record,) = recording.records()
        image = record.decode()
        assert record.digest is not None
        assert record.digest().frame_id == "cam"
    assert isinstance(image, Image)
    assert (image.stamp, image.frame_id) == (12.5, "cam")
    np.testing.assert_array_equal(image.pixels, PIXELS)


def ros1_content(store: Typestore, topic: str, message: Any) -> Content:
    name = message.__msgtype__
    schema, _ = store.generate_msgdef(name, ros_version=1)
    data = bytes(store.serialize_ros1(message, name))
    return topic, name.replace("/msg/", "/"), "ros1", schema.encode(), data


def ros1_messages() -> list[Content]:
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    header = types["std_msgs/msg/Header"](3, types["builtin_interfaces/msg/Time"](12, 500_000_000), "laser")
    ranges = np.array([1, 2, 3], np.float32)
    scan = types["sensor_msgs/msg/LaserScan"](header, -1, 1, 1, 1e-3, 0.1, 0.1, 9, ranges, ranges[:0])
    roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    info = types["sensor_msgs/msg/CameraInfo"](
        header, 480, 640, "plumb_bob", np.zeros(5), np.array(K), np.eye(3).ravel(), np.zeros(12), 0, 0, roi
    )
    return [ros1_content(store, "/scan", scan), ros1_content(store, "/info", info)]


def test_ros_1_in_an_mcap_is_read_as_in_a_bag(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", ros1_messages(), "ros1")
    with open_recording(path) as recording:
        types = {topic.name: topic.type for topic in recording.topics}
        kinds = {topic.name: topic.kind for topic in find_topics(recording)}
    assert types == {"/scan": "sensor_msgs/msg/LaserScan", "/info": "sensor_msgs/msg/CameraInfo"}
    assert kinds == {"/scan": "lidar2d", "/info": "camera_info"}
    scan, info = read(path)
    assert isinstance(scan, LaserScan)
    assert (scan.stamp, scan.frame_id) == (12.5, "laser")
    np.testing.assert_array_equal(scan.ranges, [1, 2, 3])
    assert isinstance(info, CameraInfo)


def test_an_mcap_of_ros_1_that_was_cut_off_is_read_to_its_last_chunk(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", ros1_messages() * 3, "ros1", CompressionType.ZSTD)
    content = path.read_bytes()
    path.write_bytes(content[: content.rindex(b"\x02\x14\x00\x00\x00\x00\x00\x00\x00")])
    assert len(read(path)) == 6


def test_types_without_a_reader_serve_as_triggers_with_the_time_of_arrival(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", [("/x", "my.Own", "protobuf", b"\xff\xfe", b"\x01\x02")])
    with open_recording(path) as recording:
        assert [(record.stamp, record.decode().topic_type) for record in recording.records()] == [
            (20.0, "trigger")
        ]


@pytest.mark.parametrize("message", [protobuf_cloud(), json_cloud()], ids=["protobuf", "json"])
def test_damaged_messages_are_errors_of_the_recording(tmp_path: Path, message: Content) -> None:
    *head, data = message
    rng = np.random.default_rng(0)
    refused = 0
    for number in range(200):
        damaged = bytearray(data[: rng.integers(1, len(data))] if number % 2 else data)
        for _ in range(number % 3):
            damaged[rng.integers(len(damaged))] = rng.integers(256)
        path = write_mcap(tmp_path / "a.mcap", [(*head, bytes(damaged))])  # type: ignore[list-item]
        try:
            with open_recording(path) as recording:
                for record in recording.records():
                    assert record.digest is not None
                    record.digest()
                    record.decode()
        except RecordingError:
            refused += 1
    assert refused > 50


def test_messages_with_more_parts_than_any_sensor_sends_are_refused(tmp_path: Path) -> None:
    topic, name, encoding, schema, data = protobuf_cloud()
    path = write_mcap(tmp_path / "a.mcap", [(topic, name, encoding, schema, data + b"\x2a\x00" * 1000)])
    with pytest.raises(RecordingError, match="has more than 1000 fields"):
        read(path)


def test_inspection_names_frames_and_contents(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", [protobuf_cloud()])
    with open_recording(path) as recording:
        (topic,) = inspect_recording(recording, lambda _: None).topics
    assert (topic.kind, topic.type, topic.frame_id) == ("lidar3d", "foxglove.PointCloud", "lidar")
    assert topic.content == "2 points, 2 rings, with times"
