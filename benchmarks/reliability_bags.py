"""One small recording, its messages as ROS has them, and the same messages in every form that calgraph reads."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.convert.converter import migrate_message
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from calgraph.io.text_writing import save_yaml
from calgraph.io.yaml_reading import read_yaml
from calgraph.simulation import (
    CameraOptions,
    GroundTruth,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    load_truth,
    simulate_rig,
)

STORE, STORE1 = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
CAMERA, LASER, LIDAR = "/camera/image_raw/compressed", "/laser_front/scan", "/lidar/points"
INFO, TRIGGER = "/camera/camera_info", "/trigger"
SCENARIO = RigScenario(
    camera=CameraOptions(width=320, height=240, rate=4.0, texels_per_mm=1.0),
    laser=LaserOptions(count=1, rate=10.0, resolution=0.5),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=1, rate=5.0, resolution=0.8),
    bearings=(-30, -10, 10, 30),
    radii=(1.6,),
    samples=3,
    background=1.5,
    hold_time=1.0,
    move_time=0.5,
    clutter=2,
)
"""A camera, a 2-D scanner and a 16-beam LiDAR, 12 captures in 20 s: 8 MB, calibrated in 3 s."""
TOLERANCE = {"translation": 0.05, "rotation": 2.0}
"""Of the rig, m and degrees: wide, so that poses from so little are good, and wrong ones confidently wrong."""
_FOLDERS = {CAMERA: "camera", LASER: "laser_front", LIDAR: "lidar"}


@dataclass(frozen=True)
class Item:
    """A message of a recording."""

    topic: str
    kind: str
    """Its ROS type."""
    arrival: int
    """ns."""
    message: Any
    """The deserialized message; None stands for a topic without messages."""


@dataclass(frozen=True)
class Source:
    """The recording that is damaged, with its rig and ground truth."""

    folder: Path
    items: tuple[Item, ...]
    rig: Mapping[str, Any]
    """For bags: the content of rig.yaml."""
    folder_rig: Mapping[str, Any]
    """For plain folders, which have no trigger."""
    truth: GroundTruth

    def rig_of(self, form: str) -> Mapping[str, Any]:
        """The content of rig.yaml for a form of the recording."""
        return self.folder_rig if form == FOLDER else self.rig


def simulate_source(folder: Path, seed: int) -> Source:
    """Simulates the recording that is damaged."""
    simulate_rig(SCENARIO, folder, seed)
    save_yaml(folder / "scenario.yaml", SCENARIO.model_dump(mode="json", exclude_none=True))
    rig = {**read_yaml(folder / "rig.yaml"), "tolerance": TOLERANCE}
    sensors = {name: {**spec} for name, spec in rig["sensors"].items()}
    for name, spec in sensors.items():
        spec["topic"] = name
        if "camera_info" in spec:
            spec["camera_info"] = f"{name}/camera_info"
    capture = {key: value for key, value in rig["capture"].items() if key != "trigger"}
    with Reader(folder / "recording") as reader:
        items = tuple(
            Item(c.topic, c.msgtype, arrival, STORE.deserialize_cdr(raw, c.msgtype))
            for c, arrival, raw in reader.messages()
        )
    truth = load_truth(folder / "truth.yaml")
    return Source(folder, items, rig, {**rig, "capture": capture, "sensors": sensors}, truth)


def write_rig(path: Path, content: Mapping[str, Any]) -> None:
    """Writes a rig.yaml."""
    save_yaml(path, dict(content))


def stamp_of(item: Item) -> float:
    """The header stamp of a message, s."""
    header = getattr(item.message, "header", item.message)
    return float(header.stamp.sec + header.stamp.nanosec / 1e9)


def with_stamp(item: Item, seconds: float) -> Item:
    """The message with another header stamp."""
    sec, nanosec = divmod(round(seconds * 1e9), 10**9)
    stamp = STORE.types["builtin_interfaces/msg/Time"](sec=max(-(2**31), min(sec, 2**31 - 1)), nanosec=nanosec)
    if item.kind == "std_msgs/msg/Header":
        return replace(item, message=replace(item.message, stamp=stamp))
    return with_fields(item, header=replace(item.message.header, stamp=stamp))


def with_fields(item: Item, **fields: Any) -> Item:
    """The message with other fields."""
    return replace(item, message=replace(item.message, **fields))


def write_bag2(path: Path, items: Sequence[Item], storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
    """Writes a rosbag2 folder."""
    with Writer(path, version=8, storage_plugin=storage) as writer:
        connections: dict[tuple[str, str], Any] = {}
        for item in items:
            key = item.topic, item.kind
            if key not in connections:
                connections[key] = writer.add_connection(*key, typestore=STORE)
            if item.message is not None:
                writer.write(connections[key], item.arrival, STORE.serialize_cdr(item.message, item.kind))
    return path


def write_bag1(path: Path, items: Sequence[Item]) -> Path:
    """Writes a ROS 1 bag."""
    path = path.with_name(f"{path.name}.bag")
    cache: dict[str, object] = {}
    with Writer1(path) as writer:
        connections: dict[tuple[str, str], Any] = {}
        for item in items:
            key = item.topic, item.kind
            if key not in connections:
                connections[key] = writer.add_connection(*key, typestore=STORE1)
            if item.message is not None:
                message = migrate_message(STORE, STORE1, item.kind, item.kind, cache, item.message)
                writer.write(connections[key], item.arrival, STORE1.serialize_ros1(message, item.kind))
    return path


def write_folder(path: Path, items: Sequence[Item]) -> Path:
    """Writes a plain folder; triggers are left out."""
    path.mkdir(parents=True)
    for item in items:
        if item.topic == INFO and item.message is not None:
            _write_camera_info(path / "camera" / "camera_info.yaml", item.message)
        if item.topic not in _FOLDERS or item.message is None:
            continue
        file = path / _FOLDERS[item.topic] / f"{stamp_of(item):.9f}"
        file.parent.mkdir(exist_ok=True)
        write: Callable[..., None] = _FILE_WRITERS.get(item.kind, _write_other)
        write(file, item.message)
    return path


def _write_camera_info(file: Path, info: Any) -> None:
    file.parent.mkdir(exist_ok=True)
    content = {
        "width": int(info.width), "height": int(info.height), "distortion_model": info.distortion_model,
        "K": info.k.tolist(), "D": info.d.tolist(),
    }  # fmt: skip
    with file.open("w", encoding="utf-8") as opened:
        YAML().dump(content, opened)


def _write_image(file: Path, message: Any) -> None:
    file.with_name(f"{file.name}.jpg").write_bytes(message.data.tobytes())


def _write_raw_image(file: Path, message: Any) -> None:
    pixels = np.resize(message.data, (message.height, message.width, 3)) if message.data.size else np.zeros(0)
    encoded = cv2.imencode(".png", pixels)[1].tobytes() if pixels.size else b""
    file.with_name(f"{file.name}.png").write_bytes(encoded)


def _write_scan(file: Path, message: Any) -> None:
    values = {
        "stamp": message.header.stamp.sec + message.header.stamp.nanosec / 1e9, "angle_min": message.angle_min,
        "angle_increment": message.angle_increment, "time_increment": message.time_increment,
    }  # fmt: skip
    np.savez(file.with_name(f"{file.name}.npz"), ranges=message.ranges, **values)


def _write_cloud(file: Path, message: Any) -> None:
    names = {field.name: field for field in message.fields}
    codes = {2: "u1", 4: "<u2", 6: "<u4", 7: "<f4", 8: "<f8"}
    layout = np.dtype(
        {
            "names": list(names),
            "formats": [codes[field.datatype] for field in names.values()],
            "offsets": [field.offset for field in names.values()],
            "itemsize": message.point_step,
        }
    )
    whole = message.data[: message.data.size // message.point_step * message.point_step]
    points = whole.view(layout) if {"x", "y", "z"} <= set(names) else np.zeros(0, layout)
    xyz = np.column_stack([points[axis] for axis in "xyz"]) if len(points) else np.zeros((0, 3))
    extra = {name: points[name] for name in names if name not in "xyz" and len(points)}
    np.savez(file.with_name(f"{file.name}.npz"), points=xyz, **extra)


def _write_other(file: Path, _message: Any) -> None:
    """A message of a type that the folder has no form for: an empty file."""
    file.with_name(f"{file.name}.png").write_bytes(b"")


_FILE_WRITERS: Mapping[str, Callable[..., None]] = {
    "sensor_msgs/msg/CompressedImage": _write_image,
    "sensor_msgs/msg/Image": _write_raw_image,
    "sensor_msgs/msg/LaserScan": _write_scan,
    "sensor_msgs/msg/PointCloud2": _write_cloud,
}
FOLDER = "plain folder, NPZ"
FORMS: Mapping[str, Callable[[Path, Sequence[Item]], Path]] = {
    "MCAP": write_bag2,
    "SQLite": lambda path, items: write_bag2(path, items, StoragePlugin.SQLITE3),
    "ROS 1 bag": write_bag1,
    FOLDER: write_folder,
}
