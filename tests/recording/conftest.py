"""Recordings made by hand, with rosbags as the oracle for the bytes."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from calgraph.recording import open_recording
from calgraph.sensors import Message, RecordedMessage
from ros_bags import Item, write_bag2

MakeBag = Callable[..., Path]


@pytest.fixture
def store() -> Typestore:
    return get_typestore(Stores.ROS2_HUMBLE)


@pytest.fixture
def ros(store: Typestore) -> SimpleNamespace:
    """Makers of ROS 2 messages with sensible defaults."""

    def header(stamp: float = 12.5, frame_id: str = "sensor") -> Any:
        sec, nanosec = divmod(round(stamp * 1e9), 10**9)
        time = store.types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
        return store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)

    def scan(**fields: Any) -> Any:
        defaults: dict[str, Any] = {
            "header": header(), "angle_min": -0.5, "angle_max": 0.5, "angle_increment": 0.25,
            "time_increment": 1e-3, "scan_time": 0.1, "range_min": 0.5, "range_max": 8.0,
            "ranges": np.array([1, 2, 3, 4, 5], np.float32), "intensities": np.zeros(0, np.float32),
        }  # fmt: skip
        return store.types["sensor_msgs/msg/LaserScan"](**{**defaults, **fields})

    def image(pixels: np.ndarray[Any, Any], encoding: str, **fields: Any) -> Any:
        defaults: dict[str, Any] = {
            "header": header(), "height": pixels.shape[0], "width": pixels.shape[1], "encoding": encoding,
            "is_bigendian": 0, "step": pixels[0].nbytes, "data": np.frombuffer(pixels.tobytes(), np.uint8),
        }  # fmt: skip
        return store.types["sensor_msgs/msg/Image"](**{**defaults, **fields})

    def compressed(data: bytes, declared: str) -> Any:
        return store.types["sensor_msgs/msg/CompressedImage"](
            header=header(), format=declared, data=np.frombuffer(data, np.uint8)
        )

    def camera_info(**fields: Any) -> Any:
        roi = store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        defaults: dict[str, Any] = {
            "header": header(), "height": 480, "width": 640, "distortion_model": "plumb_bob",
            "d": np.array([0.1, -0.2, 0.001, 0.002, 0.03]),
            "k": np.array([500.0, 0, 320, 0, 510, 240, 0, 0, 1]), "r": np.eye(3).ravel(), "p": np.zeros(12),
            "binning_x": 0, "binning_y": 0, "roi": roi,
        }  # fmt: skip
        return store.types["sensor_msgs/msg/CameraInfo"](**{**defaults, **fields})

    return SimpleNamespace(
        header=header, scan=scan, image=image, compressed=compressed, camera_info=camera_info, types=store.types
    )


@pytest.fixture
def make_bag(tmp_path: Path) -> MakeBag:
    """Writes ``(topic, message, arrival in s)`` as a rosbag2."""

    def make(
        *messages: tuple[str, Any, float],
        name: str = "bag",
        storage: StoragePlugin = StoragePlugin.MCAP,
        compression: CompressionMode = CompressionMode.NONE,
    ) -> Path:
        items = [Item(topic, one.__msgtype__, round(arrival * 1e9), one) for topic, one, arrival in messages]
        return write_bag2(tmp_path / name, items, storage, compression)

    return make


@pytest.fixture
def make_ros1_bag(tmp_path: Path) -> MakeBag:
    """Writes ``(topic, message, arrival in s)`` of ROS 1 types as a bag."""

    def make(*messages: tuple[str, Any, float], compression: Writer1.CompressionFormat | None = None) -> Path:
        path = tmp_path / "old.bag"
        old = get_typestore(Stores.ROS1_NOETIC)
        writer = Writer1(path)
        if compression:
            writer.set_compression(compression)
        with writer:
            connections: dict[str, Any] = {}
            for topic, message, arrival in messages:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=old)
                data = old.serialize_ros1(message, message.__msgtype__)
                writer.write(connections[topic], round(arrival * 1e9), data)
        return path

    return make


@pytest.fixture
def decoded(make_bag: MakeBag) -> Callable[[Any], Message]:
    """What one ROS 2 message is read back as."""

    def read(message: Any) -> Message:
        with open_recording(make_bag(("/topic", message, 20.0))) as recording:
            return next(recording.records()).decode()

    return read


@pytest.fixture
def read_all() -> Callable[[Path], list[RecordedMessage]]:
    def read(path: Path) -> list[RecordedMessage]:
        with open_recording(path) as recording:
            return list(recording.records())

    return read
