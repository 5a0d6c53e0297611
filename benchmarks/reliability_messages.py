"""Messages of a small recording, damaged as by failed sensors and recorders, in every form that calgraph reads."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.convert.converter import migrate_message
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore
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
    """Simulates the recording that is damaged, and reads it."""
    simulate_rig(SCENARIO, folder, seed)
    return read_source(folder)


def read_source(folder: Path) -> Source:
    """A recording that was simulated before."""
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


def write_bag2(
    path: Path,
    items: Sequence[Item],
    storage: StoragePlugin = StoragePlugin.MCAP,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """Writes a rosbag2 folder."""
    writer = Writer(path, version=8, storage_plugin=storage)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        _write_items(writer, STORE, items, lambda item: STORE.serialize_cdr(item.message, item.kind))
    return path


def write_bag1(path: Path, items: Sequence[Item], compression: Writer1.CompressionFormat | None = None) -> Path:
    """Writes a ROS 1 bag."""
    path = path.with_name(f"{path.name}.bag")
    writer = Writer1(path)
    if compression:
        writer.set_compression(compression)
    with writer:
        _write_items(writer, STORE1, items, serialize_ros1)
    return path


def serialize_ros1(item: Item) -> memoryview:
    """The message as one of ROS 1."""
    message = migrate_message(STORE, STORE1, item.kind, item.kind, {}, item.message)
    return STORE1.serialize_ros1(message, item.kind)


def _write_items(
    writer: Writer | Writer1, store: Typestore, items: Sequence[Item], serialize: Callable[[Item], Any]
) -> None:
    connections: dict[tuple[str, str], Any] = {}
    for item in items:
        key = item.topic, item.kind
        if key not in connections:
            connections[key] = writer.add_connection(*key, typestore=store)
        if item.message is not None:
            writer.write(connections[key], item.arrival, serialize(item))


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

Items = Sequence[Item]
Change = Callable[[Items, np.random.Generator], Items]
SENSORS = CAMERA, LASER, LIDAR
_DAY = 86400.0


def _choose(rng: np.random.Generator) -> str:
    return SENSORS[int(rng.integers(len(SENSORS)))]


def _some(items: Items, rng: np.random.Generator, share: float, change: Callable[[Item], Item | None]) -> Items:
    """Changes a random share of the messages; None removes one."""
    chosen = rng.random(len(items)) < share
    changed = [change(item) if hit else item for item, hit in zip(items, chosen, strict=True)]
    return [item for item in changed if item is not None]


def _of_topic(items: Items, topic: str, change: Callable[[Item], Item | None], share: float = 1.0,
              rng: np.random.Generator | None = None) -> Items:  # fmt: skip
    """Changes messages of one topic, all or a random share of them."""
    hits = np.ones(len(items), bool) if rng is None else rng.random(len(items)) < share
    changed = [change(one) if one.topic == topic and hit else one for one, hit in zip(items, hits, strict=True)]
    return [item for item in changed if item is not None]


def _sorted(items: Items) -> Items:
    return sorted(items, key=lambda item: item.arrival)


def duplicated(items: Items, rng: np.random.Generator) -> Items:
    """A fifth of the messages twice."""
    return [one for item in items for one in [item] * (2 if rng.random() < 0.2 else 1)]


def repeated(items: Items, rng: np.random.Generator) -> Items:
    """One message forty times."""
    at = int(rng.integers(len(items)))
    return [*items[:at], *[items[at]] * 40, *items[at:]]


def reordered(items: Items, rng: np.random.Generator) -> Items:
    """Stored in random order, with their arrival times."""
    return [items[i] for i in rng.permutation(len(items))]


def late(items: Items, rng: np.random.Generator) -> Items:
    """A tenth of the messages arrives up to two seconds late."""
    return _sorted(
        _some(items, rng, 0.1, lambda one: replace(one, arrival=one.arrival + int(rng.uniform(0, 2e9))))
    )


def lost(items: Items, rng: np.random.Generator) -> Items:
    """A random share of all messages is lost, 5 to 95 %."""
    return _some(items, rng, float(rng.uniform(0.05, 0.95)), lambda _: None)


def ended_early(items: Items, rng: np.random.Generator) -> Items:
    """One sensor ends somewhere in the recording."""
    topic, first = _choose(rng), items[0].arrival
    end = first + rng.random() * (items[-1].arrival - first)
    return _of_topic(items, topic, lambda one: one if one.arrival < end else None)


def stamps_at_zero(items: Items, rng: np.random.Generator) -> Items:
    """Stamps of one sensor that are not set: all, or some."""
    return _of_topic(items, _choose(rng), lambda one: with_stamp(one, 0.0), rng.choice([0.1, 1.0]), rng)


def stamps_in_the_future(items: Items, rng: np.random.Generator) -> Items:
    """Some stamps of one sensor are a day, a year, or as late as ROS can state."""
    ahead = float(rng.choice([_DAY, 365 * _DAY, 2**31]))
    return _of_topic(items, _choose(rng), lambda one: with_stamp(one, stamp_of(one) + ahead), 0.1, rng)


def stamps_that_jump(items: Items, rng: np.random.Generator) -> Items:
    """The clock of one sensor is set in the middle, by a second or an hour."""
    jump, middle = float(rng.choice([-1, 1, -3600, 3600])), items[len(items) // 2].arrival
    return _of_topic(
        items, _choose(rng), lambda one: with_stamp(one, stamp_of(one) + jump) if one.arrival > middle else one
    )


def stamps_that_stand(items: Items, rng: np.random.Generator) -> Items:
    """All stamps of one sensor are that of its first message."""
    topic = _choose(rng)
    first = next(stamp_of(item) for item in items if item.topic == topic)
    return _of_topic(items, topic, lambda one: with_stamp(one, first))


def empty_topic(items: Items, rng: np.random.Generator) -> Items:
    """A sensor, the trigger or the intrinsics have a topic and no message."""
    topic = str(rng.choice([*SENSORS, TRIGGER, INFO]))
    kind = next(item.kind for item in items if item.topic == topic)
    return [Item(topic, kind, 0, None), *(item for item in items if item.topic != topic)]


def missing_topic(items: Items, rng: np.random.Generator) -> Items:
    """A sensor, the trigger or the intrinsics were not recorded."""
    topic = str(rng.choice([*SENSORS, TRIGGER, INFO]))
    return [item for item in items if item.topic != topic]


def empty_clouds(items: Items, rng: np.random.Generator) -> Items:
    """Half of the clouds have no points."""
    empty = {"width": 0, "row_step": 0, "data": np.zeros(0, np.uint8)}
    return _of_topic(items, LIDAR, lambda one: with_fields(one, **empty), 0.5, rng)


def clouds_of_nan(items: Items, rng: np.random.Generator) -> Items:
    """Points of the clouds are not finite: all of some clouds, or some of all."""

    def spoil(item: Item) -> Item:
        data = item.message.data.copy()
        points = data.reshape(-1, item.message.point_step)
        hits = rng.random(len(points)) < rng.choice([0.3, 1.0])
        value = np.array([rng.choice([np.nan, np.inf, 1e30])] * 3, "<f4")
        points[hits, :12] = value.view(np.uint8)
        return with_fields(item, data=data)

    return _of_topic(items, LIDAR, spoil, 0.5, rng)


def clouds_that_contradict(items: Items, rng: np.random.Generator) -> Items:
    """Clouds with a wrong width, step or fields, or data cut short."""
    kind = int(rng.integers(4))

    def spoil(item: Item) -> Item:
        message = item.message
        match kind:
            case 0:
                return with_fields(item, width=int(message.width * 3))
            case 1:
                return with_fields(item, point_step=0)
            case 2:
                return with_fields(item, fields=message.fields[1:])
            case _:
                return with_fields(item, data=message.data[: len(message.data) // 2 + 1])

    return _of_topic(items, LIDAR, spoil, float(rng.choice([0.1, 1.0])), rng)


def images_of_zero_size(items: Items, rng: np.random.Generator) -> Items:
    """Some or all images are raw images without pixels."""
    share = float(rng.choice([0.2, 1.0]))
    chosen = rng.random(len(items)) < share

    def empty(item: Item) -> Item:
        raw = STORE.types["sensor_msgs/msg/Image"](
            header=item.message.header, height=0, width=0, encoding="bgr8", is_bigendian=0, step=0,
            data=np.zeros(0, np.uint8),
        )  # fmt: skip
        return replace(item, kind="sensor_msgs/msg/Image", message=raw)

    return [
        empty(one) if one.topic == CAMERA and hit else one for one, hit in zip(items, chosen, strict=True)
    ]  # fmt: skip


def damaged_images(items: Items, rng: np.random.Generator) -> Items:
    """Compressed images that are empty, cut short, or noise."""

    def spoil(item: Item) -> Item:
        data = item.message.data
        choices = [data[:0], data[: rng.integers(1, len(data))], rng.integers(0, 256, 500).astype(np.uint8)]
        return with_fields(item, data=choices[int(rng.integers(len(choices)))])

    return _of_topic(items, CAMERA, spoil, float(rng.choice([0.1, 0.5, 1.0])), rng)


def spoiled_intrinsics(items: Items, rng: np.random.Generator) -> Items:
    """CameraInfo with zeros, nan, another size, an unknown lens, or a change in the middle."""
    kind, middle = int(rng.integers(6)), items[len(items) // 2].arrival

    def spoil(item: Item) -> Item:
        k = item.message.k
        match kind:
            case 0:
                return with_fields(item, k=np.zeros(9))
            case 1:
                return with_fields(item, width=0, height=0, k=np.zeros(9))
            case 2:
                return with_fields(item, k=np.full(9, np.nan))
            case 3:
                return with_fields(item, width=item.message.width * 2)
            case 4:
                return with_fields(item, distortion_model="magic")
            case _:
                return with_fields(item, k=k * 1.5) if item.arrival > middle else item

    return _of_topic(items, INFO, spoil)


def spoiled_scans(items: Items, rng: np.random.Generator) -> Items:
    """Scans without ranges, of nan, inf or negative ranges, without increment, or with other numbers of beams."""
    kind, share = int(rng.integers(6)), float(rng.choice([0.3, 1.0]))

    def spoil(item: Item) -> Item:
        ranges = item.message.ranges
        match kind:
            case 0:
                return with_fields(item, ranges=ranges[:0])
            case 1:
                return with_fields(item, ranges=np.full_like(ranges, rng.choice([np.nan, np.inf, -np.inf])))
            case 2:
                return with_fields(item, ranges=-ranges)
            case 3:
                return with_fields(item, angle_increment=float(rng.choice([0.0, np.nan])))
            case 4:
                return with_fields(item, ranges=ranges[: rng.integers(1, len(ranges))])
            case _:
                return with_fields(item, time_increment=float(rng.choice([-1.0, np.nan, 10.0])))

    return _of_topic(items, LASER, spoil, share, rng)


def exchanged_topics(items: Items, rng: np.random.Generator) -> Items:
    """Two topics have the messages of each other."""
    one, other = (SENSORS[i] for i in rng.permutation(3)[:2])
    names = {one: other, other: one}
    return [replace(item, topic=names.get(item.topic, item.topic)) for item in items]


def frozen_sensor(items: Items, rng: np.random.Generator) -> Items:
    """One sensor repeats its last measurement with new stamps, from some time on."""
    topic, start = _choose(rng), items[int(rng.integers(len(items) // 2))].arrival
    last: list[Item] = []
    result = []
    for item in items:
        if item.topic != topic:
            result.append(item)
            continue
        if item.arrival <= start or not last:
            last[:] = [item]
        result.append(with_fields(last[0], header=item.message.header))
        result[-1] = replace(result[-1], arrival=item.arrival)
    return result


def changed_frames(items: Items, rng: np.random.Generator) -> Items:
    """Frames of one sensor are empty, change, or are odd names."""
    names = ["", "other", "a b\nc", "ø/é", "x" * 3000]

    def rename(item: Item) -> Item:
        return with_fields(item, header=replace(item.message.header, frame_id=str(rng.choice(names))))

    return _of_topic(items, _choose(rng), rename, 0.5, rng)


def spoiled_triggers(items: Items, rng: np.random.Generator) -> Items:
    """Triggers that are doubled, at random times, or one alone."""
    first, last = items[0].arrival, items[-1].arrival
    triggers = [item for item in items if item.topic == TRIGGER]
    others = [item for item in items if item.topic != TRIGGER]
    match int(rng.integers(3)):
        case 0:
            triggers = triggers * 2
        case 1:
            times = rng.uniform(first, last, len(triggers))
            pairs = zip(triggers, times, strict=True)
            triggers = [with_stamp(replace(item, arrival=int(time)), time / 1e9) for item, time in pairs]
        case _:
            triggers = triggers[:1]
    return _sorted([*others, *triggers])


MESSAGE_DAMAGE: Mapping[str, Change] = {
    "messages duplicated": duplicated,
    "one message 40 times": repeated,
    "stored in random order": reordered,
    "10 % arrive late": late,
    "5 to 95 % of messages lost": lost,
    "one sensor ends early": ended_early,
    "stamps 0": stamps_at_zero,
    "stamps in the future": stamps_in_the_future,
    "stamps jump": stamps_that_jump,
    "stamps stand still": stamps_that_stand,
    "topic without messages": empty_topic,
    "topic missing": missing_topic,
    "half of the clouds empty": empty_clouds,
    "points nan, inf, 1e30": clouds_of_nan,
    "clouds that contradict themselves": clouds_that_contradict,
    "images of zero size": images_of_zero_size,
    "compressed images damaged": damaged_images,
    "CameraInfo zero, nan, changing": spoiled_intrinsics,
    "scans empty, nan, irregular": spoiled_scans,
    "topics of another type": exchanged_topics,
    "one sensor frozen": frozen_sensor,
    "frames empty, odd, changing": changed_frames,
    "triggers wrong": spoiled_triggers,
}
