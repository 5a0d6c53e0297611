"""Messages of a small recording, damaged as by failed sensors and recorders, in every form that calgraph reads."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag2 import Reader, StoragePlugin
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
from ros_bags import STORE, Item, write_bag1, write_bag2

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
    return seconds_of(getattr(item.message, "header", item.message))


def seconds_of(header: Any) -> float:
    """The stamp of a header, s."""
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
Fields = Callable[[Any], dict[str, Any]]
"""New values of fields of a message."""
SENSORS = CAMERA, LASER, LIDAR
_DAY = 86400.0
_FRAMES = ("", "other", "a b\nc", "ø/é", "x" * 3000)


def _choose(rng: np.random.Generator) -> str:
    return SENSORS[int(rng.integers(len(SENSORS)))]


def _choose_topic(rng: np.random.Generator) -> str:
    return str(rng.choice([*SENSORS, TRIGGER, INFO]))


def _of_topic(items: Items, topic: str, change: Callable[[Item], Item | None], share: float = 1.0,
              rng: np.random.Generator | None = None) -> Items:  # fmt: skip
    """Changes messages of one topic, or of all if it is empty, each or a random share; None removes one."""
    hits = np.ones(len(items), bool) if rng is None else rng.random(len(items)) < share
    chosen = [hit and topic in ("", item.topic) for item, hit in zip(items, hits, strict=True)]
    changed = [change(item) if hit else item for item, hit in zip(items, chosen, strict=True)]
    return [item for item in changed if item is not None]


def _with_wrong(kinds: Sequence[Fields], rng: np.random.Generator) -> Callable[[Item], Item]:
    """A change of messages by one of some kinds of wrong fields."""
    kind = kinds[int(rng.integers(len(kinds)))]
    return lambda item: with_fields(item, **kind(item.message))


def _sorted(items: Items) -> Items:
    return sorted(items, key=lambda item: item.arrival)


def late(items: Items, rng: np.random.Generator) -> Items:
    """A tenth of the messages arrives up to two seconds late."""

    def delay(item: Item) -> Item:
        return replace(item, arrival=item.arrival + int(rng.uniform(0, 2e9)))

    return _sorted(_of_topic(items, "", delay, 0.1, rng))


def ended_early(items: Items, rng: np.random.Generator) -> Items:
    """One sensor ends somewhere in the recording."""
    topic, first = _choose(rng), items[0].arrival
    end = first + rng.random() * (items[-1].arrival - first)
    return _of_topic(items, topic, lambda one: one if one.arrival < end else None)


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
    topic = _choose_topic(rng)
    kind = next(item.kind for item in items if item.topic == topic)
    return [Item(topic, kind, 0, None), *(item for item in items if item.topic != topic)]


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
    kinds: Sequence[Fields] = (
        lambda cloud: {"width": int(cloud.width * 3)},
        lambda _: {"point_step": 0},
        lambda cloud: {"fields": cloud.fields[1:]},
        lambda cloud: {"data": cloud.data[: len(cloud.data) // 2 + 1]},
    )
    return _of_topic(items, LIDAR, _with_wrong(kinds, rng), float(rng.choice([0.1, 1.0])), rng)


def images_of_zero_size(items: Items, rng: np.random.Generator) -> Items:
    """Some or all images are raw images without pixels."""

    def empty(item: Item) -> Item:
        raw = STORE.types["sensor_msgs/msg/Image"](
            header=item.message.header, height=0, width=0, encoding="bgr8", is_bigendian=0, step=0,
            data=np.zeros(0, np.uint8),
        )  # fmt: skip
        return replace(item, kind="sensor_msgs/msg/Image", message=raw)

    return _of_topic(items, CAMERA, empty, float(rng.choice([0.2, 1.0])), rng)


def damaged_images(items: Items, rng: np.random.Generator) -> Items:
    """Compressed images that are empty, cut short, or noise."""

    def spoil(item: Item) -> Item:
        data = item.message.data
        choices = [data[:0], data[: rng.integers(1, len(data))], rng.integers(0, 256, 500).astype(np.uint8)]
        return with_fields(item, data=choices[int(rng.integers(len(choices)))])

    return _of_topic(items, CAMERA, spoil, float(rng.choice([0.1, 0.5, 1.0])), rng)


def spoiled_intrinsics(items: Items, rng: np.random.Generator) -> Items:
    """CameraInfo with zeros, nan, another size, an unknown lens, or a change in the middle."""
    later = items[len(items) // 2 + 1 :]
    middle = next((stamp_of(item) for item in later if item.topic == INFO), np.inf)
    kinds: Sequence[Fields] = (
        lambda _: {"k": np.zeros(9)},
        lambda _: {"width": 0, "height": 0, "k": np.zeros(9)},
        lambda _: {"k": np.full(9, np.nan)},
        lambda info: {"width": info.width * 2},
        lambda _: {"distortion_model": "magic"},
        lambda info: {"k": info.k * (1.5 if seconds_of(info.header) >= middle else 1.0)},
    )
    return _of_topic(items, INFO, _with_wrong(kinds, rng))


def spoiled_scans(items: Items, rng: np.random.Generator) -> Items:
    """Scans without ranges, of nan, inf or negative ranges, without increment, or with other numbers of beams."""
    kinds: Sequence[Fields] = (
        lambda scan: {"ranges": scan.ranges[:0]},
        lambda scan: {"ranges": np.full_like(scan.ranges, rng.choice([np.nan, np.inf, -np.inf]))},
        lambda scan: {"ranges": -scan.ranges},
        lambda _: {"angle_increment": float(rng.choice([0.0, np.nan]))},
        lambda scan: {"ranges": scan.ranges[: rng.integers(1, len(scan.ranges))]},
        lambda _: {"time_increment": float(rng.choice([-1.0, np.nan, 10.0]))},
    )
    return _of_topic(items, LASER, _with_wrong(kinds, rng), float(rng.choice([0.3, 1.0])), rng)


def exchanged_topics(items: Items, rng: np.random.Generator) -> Items:
    """Two topics have the messages of each other."""
    one, other = (SENSORS[i] for i in rng.permutation(3)[:2])
    names = {one: other, other: one}
    return [replace(item, topic=names.get(item.topic, item.topic)) for item in items]


def frozen_sensor(items: Items, rng: np.random.Generator) -> Items:
    """One sensor repeats its last measurement with new stamps, from some time on."""
    topic, start = _choose(rng), items[int(rng.integers(len(items) // 2))].arrival
    measured = [item for item in items if item.topic == topic]
    last = ([item for item in measured if item.arrival <= start] or measured[:1])[-1]

    def freeze(item: Item) -> Item:
        again = with_fields(last, header=item.message.header)
        return item if item.arrival <= start else replace(again, arrival=item.arrival)

    return _of_topic(items, topic, freeze)


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


def _repeat(items: Items, at: int) -> Items:
    return [*items[:at], *[items[at]] * 40, *items[at:]]


def _remove(items: Items, topic: str) -> Items:
    return [item for item in items if item.topic != topic]


def _rename_frame(item: Item, frame: str) -> Item:
    return with_fields(item, header=replace(item.message.header, frame_id=frame))


_NO_POINTS = {"width": 0, "row_step": 0, "data": np.zeros(0, np.uint8)}
MESSAGE_DAMAGE: Mapping[str, Change] = {
    "messages duplicated": lambda items, rng: [
        one for one in items for _ in range(2 if rng.random() < 0.2 else 1)
    ],
    "one message 40 times": lambda items, rng: _repeat(items, int(rng.integers(len(items)))),
    "stored in random order": lambda items, rng: [items[i] for i in rng.permutation(len(items))],
    "10 % arrive late": late,
    "5 to 95 % of messages lost": (
        lambda items, rng: _of_topic(items, "", lambda _: None, float(rng.uniform(0.05, 0.95)), rng)
    ),
    "one sensor ends early": ended_early,
    "stamps 0": lambda items, rng: _of_topic(
        items, _choose(rng), lambda one: with_stamp(one, 0.0), rng.choice([0.1, 1.0]), rng
    ),
    "stamps in the future": stamps_in_the_future,
    "stamps jump": stamps_that_jump,
    "stamps stand still": stamps_that_stand,
    "topic without messages": empty_topic,
    "topic missing": lambda items, rng: _remove(items, _choose_topic(rng)),
    "half of the clouds empty": (
        lambda items, rng: _of_topic(items, LIDAR, lambda one: with_fields(one, **_NO_POINTS), 0.5, rng)
    ),
    "points nan, inf, 1e30": clouds_of_nan,
    "clouds that contradict themselves": clouds_that_contradict,
    "images of zero size": images_of_zero_size,
    "compressed images damaged": damaged_images,
    "CameraInfo zero, nan, changing": spoiled_intrinsics,
    "scans empty, nan, irregular": spoiled_scans,
    "topics of another type": exchanged_topics,
    "one sensor frozen": frozen_sensor,
    "frames empty, odd, changing": (
        lambda items, rng: _of_topic(
            items, _choose(rng), lambda one: _rename_frame(one, str(rng.choice(_FRAMES))), 0.5, rng
        )
    ),
    "triggers wrong": spoiled_triggers,
}
