"""Messages that drivers record instead of PointCloud2: Livox's points, Velodyne's packets, PointCloud."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from calgraph.errors import RecordingError
from calgraph.geometry import Array
from calgraph.recording import find_topics, open_recording
from calgraph.recording.driver_types import DEFINITIONS, read_livox_points
from calgraph.recording.velodyne_packets import columns_from_velodyne
from calgraph.sensors import Message, PointCloud

Decoded = Callable[[Any], Message]


def make_store(release: Stores) -> Typestore:
    store = get_typestore(release)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def livox_message(store: Typestore, package: str, header: Any, count: int = 3) -> Any:
    point = store.types[f"{package}/msg/CustomPoint"]
    points = [point(k * 25_000_000, k + 1.0, -k - 2.0, 0.5, 9, 1, k % 4) for k in range(count)]
    return store.types[f"{package}/msg/CustomMsg"](header, 5, count, 0, np.zeros(3, np.uint8), points)


@pytest.mark.parametrize("package", ["livox_ros_driver", "livox_ros_driver2", "livox_interfaces"])
@pytest.mark.parametrize("frame", ["", "livox", "livox_f", "livox_fr", "livox_fra"])
@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_points_of_a_livox_are_those_that_were_serialised(package: str, frame: str, encoding: str) -> None:
    store = make_store(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    time = store.types["builtin_interfaces/msg/Time"](12, 500_000_000)
    header = store.types["std_msgs/msg/Header"](*((3,) if encoding == "ros1" else ()), time, frame)
    message = livox_message(store, package, header)
    serialize = store.serialize_ros1 if encoding == "ros1" else store.serialize_cdr
    raw = bytes(serialize(message, message.__msgtype__))
    points = read_livox_points(raw, ros1=encoding == "ros1")
    np.testing.assert_array_equal(points["x"], [1, 2, 3])
    np.testing.assert_array_equal(points["z"], [0.5, 0.5, 0.5])
    np.testing.assert_array_equal(points["offset_time"], [0, 25_000_000, 50_000_000])


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_livox_is_a_lidar_whose_points_have_times_and_no_rings(tmp_path: Path, storage: StoragePlugin) -> None:
    """Databases of ROS 2 Humble do not define the types of their messages."""
    store = make_store(Stores.ROS2_HUMBLE)
    header = store.types["std_msgs/msg/Header"](
        store.types["builtin_interfaces/msg/Time"](12, 500_000_000), "livox"
    )
    message = livox_message(store, "livox_ros_driver2", header)
    with Writer(tmp_path / "bag", version=8, storage_plugin=storage) as writer:
        connection = writer.add_connection("/livox/lidar", message.__msgtype__, typestore=store)
        writer.write(connection, 20 * 10**9, store.serialize_cdr(message, message.__msgtype__))
    with open_recording(tmp_path / "bag") as recording:
        (topic,) = find_topics(recording)
        cloud = next(recording.records()).decode()
    assert (topic.kind, topic.frame_id) == ("lidar3d", "livox")
    assert isinstance(cloud, PointCloud)
    assert cloud.stamp == 12.5
    np.testing.assert_array_equal(cloud.points, [[1, -2, 0.5], [2, -3, 0.5], [3, -4, 0.5]])
    assert cloud.rings is None
    assert cloud.times is not None
    np.testing.assert_allclose(cloud.times, [0, 0.025, 0.05])


def test_a_livox_message_that_is_cut_short_is_named() -> None:
    store = make_store(Stores.ROS2_HUMBLE)
    header = store.types["std_msgs/msg/Header"](store.types["builtin_interfaces/msg/Time"](12, 0), "livox")
    raw = bytes(
        store.serialize_cdr(message := livox_message(store, "livox_ros_driver", header), message.__msgtype__)
    )
    with pytest.raises(ValueError, match="states 3 points of 20 bytes, and has 58 bytes of them"):
        read_livox_points(raw[:-1], ros1=False)
    with pytest.raises(ValueError, match="too short for a cloud of a Livox"):
        read_livox_points(raw[:20], ros1=False)


def velodyne_packet(
    product: int, azimuths: Array, distances: Array, mode: int = 0x37, flag: int = 0xEEFF
) -> bytes:
    """A packet of 12 blocks with azimuths (12,), degrees, and distances (12, 32) in the units of the model."""
    packet = b""
    for azimuth, row in zip(azimuths, distances, strict=True):
        packet += flag.to_bytes(2, "little") + round(100 * azimuth % 36000).to_bytes(2, "little")
        packet += b"".join(int(value).to_bytes(2, "little") + b"\x07" for value in row)
    return packet + bytes(4) + bytes([mode, product])


def one_return(block: int, channel: int, distance: int) -> Array:
    distances = np.zeros((12, 32))
    distances[block, channel] = distance
    return distances


@pytest.mark.parametrize(
    ("product", "channel", "unit", "elevation", "height", "ahead", "time", "duration", "ring"),
    [
        (0x22, 1, 0.002, 1.0, -0.0007, 0.0, 2.304, 110.592, 8),  # VLP-16, first sequence
        (0x22, 16, 0.002, -15.0, 0.0112, 0.0, 55.296, 110.592, 0),  # second sequence
        (0x22, 31, 0.002, 15.0, -0.0112, 0.0, 55.296 + 34.56, 110.592, 15),
        (0x24, 3, 0.002, 2.0, -0.0018, 0.0, 6.912, 110.592, 9),  # Puck Hi-Res
        (0x21, 15, 0.002, 0.0, 0.0, 0.0, 17.28, 46.08, 23),  # HDL-32E
        (0x28, 1, 0.004, -1.0, 0.0, -4.2, 0.0, 55.296, 17),  # VLP-32C
        (0x28, 29, 0.004, 15.0, 0.0, -1.4, 32.256, 55.296, 31),
    ],
)
def test_returns_of_a_velodyne_are_where_its_manual_puts_them(
    product: int, channel: int, unit: float, elevation: float, height: float, ahead: float, time: float,
    duration: float, ring: int,
) -> None:  # fmt: skip
    """Block 3 of 12, each 0.4° after the one before, past 360°."""
    packet = velodyne_packet(product, 359.0 + 0.4 * np.arange(12.0), one_return(3, channel, 2500))
    columns = columns_from_velodyne([packet], np.array([0.1]))
    azimuth = np.radians(359.0 + 3 * 0.4 + 0.4 * time / duration + ahead)
    level, up = 2500 * unit * np.cos(np.radians(elevation)), 2500 * unit * np.sin(np.radians(elevation))
    found = np.array([columns["x"][0], columns["y"][0], columns["z"][0]])
    # Azimuths of packets are rounded to 0.01°.
    np.testing.assert_allclose(
        found, [level * np.cos(azimuth), -level * np.sin(azimuth), up + height], atol=2e-4 * level
    )
    np.testing.assert_allclose(columns["z"], up + height, atol=1e-3)
    np.testing.assert_allclose(columns["time"], 0.1 + 1e-6 * (3 * duration + time), atol=1e-12)
    np.testing.assert_array_equal(columns["ring"], [ring])


def test_second_returns_of_a_velodyne_count_where_they_differ() -> None:
    distances = np.zeros((12, 32))
    distances[0, :3], distances[1, :3] = [1000, 2000, 3000], [1000, 2500, 0]
    columns = columns_from_velodyne(
        [velodyne_packet(0x22, np.repeat(0.4 * np.arange(6.0), 2), distances, mode=0x39)], np.zeros(1)
    )
    lengths = np.sort(np.sqrt(columns["x"] ** 2 + columns["y"] ** 2))
    np.testing.assert_allclose(lengths, [2 * np.cos(np.radians(15)), 4, 5, 6 * np.cos(np.radians(13))], rtol=1e-3)
    np.testing.assert_allclose(np.unique(columns["time"]), [0, 2.304e-6, 4.608e-6])


@pytest.mark.parametrize(
    ("packet", "message"),
    [
        (
            velodyne_packet(0xA1, np.zeros(12), np.zeros((12, 32))),
            "product 0xa1 are not known.*velodyne_pointcloud",
        ),
        (
            velodyne_packet(0x22, np.zeros(12), np.zeros((12, 32)), flag=0xDDFF),
            "HDL-64E need the calibration file",
        ),
        (bytes(1205), r"have 1206 bytes, got \[1205\]"),
    ],
)
def test_packets_that_are_not_known_name_the_device(packet: bytes, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        columns_from_velodyne([packet], np.zeros(1))


def test_a_scan_of_packets_is_a_cloud(tmp_path: Path) -> None:
    store = make_store(Stores.ROS2_HUMBLE)
    time = store.types["builtin_interfaces/msg/Time"]
    packets = [
        store.types["velodyne_msgs/msg/VelodynePacket"](
            time(12, 400_000_000 + 50_000_000 * k),
            np.frombuffer(
                velodyne_packet(0x22, 90.0 * k + 0.4 * np.arange(12.0), np.full((12, 32), 1000)), np.uint8
            ),
        )
        for k in range(3)
    ]
    header = store.types["std_msgs/msg/Header"](time(12, 500_000_000), "velodyne")
    message = store.types["velodyne_msgs/msg/VelodyneScan"](header, packets)
    with Writer(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/packets", message.__msgtype__, typestore=store)
        writer.write(connection, 20 * 10**9, store.serialize_cdr(message, message.__msgtype__))
    with open_recording(tmp_path / "bag") as recording:
        cloud = next(recording.records()).decode()
    assert isinstance(cloud, PointCloud)
    assert (len(cloud.points), cloud.frame_id, cloud.stamp) == (3 * 12 * 32, "velodyne", 12.5)
    assert cloud.times is not None
    assert cloud.times.min() == pytest.approx(-0.1, abs=1e-6)
    assert cloud.duration == pytest.approx(0.1 + 11 * 110.592e-6 + 55.296e-6 + 34.56e-6, abs=1e-6)
    assert cloud.rings is not None
    np.testing.assert_array_equal(np.unique(cloud.rings), np.arange(16))


def test_clouds_of_the_type_before_point_cloud_2_are_read(ros: SimpleNamespace, decoded: Decoded) -> None:
    point, channel = ros.types["geometry_msgs/msg/Point32"], ros.types["sensor_msgs/msg/ChannelFloat32"]
    message = ros.types["sensor_msgs/msg/PointCloud"](
        ros.header(), [point(1, 2, 3), point(0, 0, 0), point(4, 5, 6)],
        [channel("ring", np.array([7, 8, 9], np.float32)), channel("odd", np.zeros(2, np.float32))],
    )  # fmt: skip
    cloud = decoded(message)
    assert isinstance(cloud, PointCloud)
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(cloud.rings, [7, 9])


def test_damaged_points_of_a_livox_are_errors_of_the_recording(tmp_path: Path) -> None:
    store = make_store(Stores.ROS2_HUMBLE)
    header = store.types["std_msgs/msg/Header"](store.types["builtin_interfaces/msg/Time"](12, 0), "livox")
    message = livox_message(store, "livox_ros_driver2", header)
    raw = bytes(store.serialize_cdr(message, message.__msgtype__))
    with Writer(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/livox/lidar", message.__msgtype__, typestore=store)
        writer.write(connection, 20 * 10**9, raw[:-40])
    with open_recording(tmp_path / "bag") as recording, pytest.raises(RecordingError, match="states 3 points"):
        next(recording.records()).decode()
