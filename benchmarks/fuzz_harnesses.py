"""What is fuzzed: each harness gives bytes to one of calgraph's readers as a file, and uses what it returns.

The property: it returns, or raises one of calgraph's own errors.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import cache
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rosbags.interfaces import MessageDefinitionFormat

import fuzz_mutators as mutators
import fuzz_seeds as seeds
from calgraph.cli.setting_options import override_settings
from calgraph.config import Rig, draft_rig, load_rig, printed_bitmaps
from calgraph.config.board_print import black_rectangles
from calgraph.io.text_writing import format_json
from calgraph.io.yaml_reading import read_yaml, validate_content
from calgraph.printing.target_block import read_boards
from calgraph.recording import (
    MessageRecording,
    Recording,
    RecordingCache,
    find_topics,
    inspect_recording,
    open_recording,
)
from calgraph.recording.decoding import decode
from calgraph.recording.message_types import TypeDefinition, make_message_type
from calgraph.result import Calibration, export, load_calibration, load_pair_budget, load_scene, read_extrinsics
from calgraph.rig.bundle.problem_file import load_problem
from calgraph.rig.captures.sensor_detection import KEPT_TYPES
from calgraph.sensors import Trigger
from calgraph.simulation import NetworkScenario, RigScenario, load_truth

_MAX_RECORDS = 200


@dataclass(frozen=True)
class Harness:
    """One reader."""

    run: Callable[[bytes, Path], None]
    """Gives the bytes to the reader; the folder is empty, and its content is removed afterwards."""
    seeds: seeds.Seeds
    mutate: mutators.Mutator | None = None
    words: tuple[str, ...] = field(default=())
    """Of the reader's language, for mutations of bytes."""


def _write(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    return path


def _rig(data: bytes, folder: Path) -> None:
    rig = load_rig(_write(folder, "rig.yaml", data))
    rig.camera_models()
    for board in rig.boards:
        printed_bitmaps(board)
        black_rectangles(board)
    assert Rig.model_validate(rig.to_plain()) == rig


def _settings(data: bytes, folder: Path) -> None:
    rig = load_rig(_write(folder, "rig.yaml", seeds.RIG))
    override_settings(rig, data.decode(errors="replace").splitlines()[:20])


def _reads(name: str, read: Callable[[Path], object]) -> Callable[[bytes, Path], None]:
    """Gives the bytes to what reads a file of this name."""

    def run(data: bytes, folder: Path) -> None:
        read(_write(folder, name, data))

    return run


def _calibration(data: bytes, folder: Path) -> None:
    calibration = load_calibration(_write(folder, "calibration.yaml", data))
    for format in ("json", "tf", "launch", "urdf"):
        export(calibration, format)


def _budget(data: bytes, folder: Path) -> None:
    names = [sensor.name for sensor in _calibration_of_seeds().sensors]
    for a, b in (names[:2], names[1::-1]):
        load_pair_budget(_write(folder, "budget.csv", data), _calibration_of_seeds(), a, b)


def _extrinsics(data: bytes, folder: Path) -> None:
    path = _write(folder, "a.yaml", data)
    file = read_extrinsics(path)
    frames = sorted(file.tree.frames)[:4]
    file.frames_of_sensors({"camera": "camera", "lidar": ""})
    for frame in frames:
        file.transform(frames[0], frame)


@cache
def _calibration_of_seeds() -> Calibration:
    with TemporaryDirectory() as folder:
        return load_calibration(
            _write(Path(folder), "calibration.yaml", seeds.written_files()["calibration.yaml"])
        )


def _urdf(data: bytes, _folder: Path) -> None:
    export(_calibration_of_seeds(), "urdf", urdf=data.decode(errors="replace"))


def _scenario(data: bytes, folder: Path) -> None:
    path = _write(folder, "scenario.yaml", data)
    content = read_yaml(path)
    validate_content(NetworkScenario if "scanner" in content else RigScenario, content, path)


def _scene(data: bytes, folder: Path) -> None:
    scene = load_scene(_write(folder, "scene.npz", data))
    for snapshot in scene.snapshots[:3]:
        _ = snapshot.picture


def _ignore(_: float) -> None:
    pass


def _inspect(recording: Recording) -> None:
    format_json(asdict(inspect_recording(recording, _ignore)))
    for record in islice(recording.records(), _MAX_RECORDS):
        record.decode()
        if record.digest:
            record.digest()
    draft_rig(find_topics(recording), "recording")


def _file(name: str) -> Callable[[bytes, Path], None]:
    """A recording of this one file."""

    def run(data: bytes, folder: Path) -> None:
        _write(folder, name, data)
        with open_recording(folder if "/" in name else folder / name) as recording:
            _inspect(recording)

    return run


def _camera_info(data: bytes, folder: Path) -> None:
    _write(folder, "s/1.0.png", seeds.images()[0])
    _file("s/camera_info.yaml")(data, folder)


def _metadata(data: bytes, folder: Path) -> None:
    _write(folder, "a.mcap", seeds.mcaps()[0])
    _write(folder, "metadata.yaml", data)
    with open_recording(folder) as recording:
        _inspect(recording)


def _message(data: bytes, _folder: Path) -> None:
    if not data:
        return
    kind, ros1 = divmod(data[0] % (2 * len(seeds.MESSAGE_TYPES)), 2)
    definition = TypeDefinition(
        seeds.MESSAGE_TYPES[kind], MessageDefinitionFormat.NONE, "", "ros1" if ros1 else "cdr"
    )
    decode(make_message_type(definition), data[1:], 12.0, "a")


def _driver_message(data: bytes, _folder: Path) -> None:
    """A message of a driver or of Foxglove: the first byte states type and serialisation."""
    if not data:
        return
    name, encoding = seeds.DRIVER_TYPES[data[0] % len(seeds.DRIVER_TYPES)]
    kind = make_message_type(TypeDefinition(name, MessageDefinitionFormat.NONE, "", encoding))
    with suppress(Exception):  # what reads recordings gives errors a place
        kind.header_stamp(data[1:])
    kind.digest(data[1:])
    decode(kind, data[1:], 12.0, "a")


def _definition(data: bytes, _folder: Path) -> None:
    """A definition in a bag, and a message of it: the first byte states language, serialisation, and type."""
    if len(data) < 2:
        return
    language = (MessageDefinitionFormat.MSG, MessageDefinitionFormat.IDL)[data[0] & 1]
    name = (*seeds.MESSAGE_TYPES, "a/msg/T")[data[0] // 4 % (len(seeds.MESSAGE_TYPES) + 1)]
    text = data[2:].decode(errors="replace")
    make_message_type.cache_clear()  # of 256 types, whose definitions may be long
    kind = make_message_type(TypeDefinition(name, language, text, "ros1" if data[0] & 2 else "cdr"))
    raw = b"\x00\x01\x00\x00" + bytes([data[1]]) + bytes(range(255)) * 2
    decode(kind, raw, 12.0, "a")


class _OneEntry(RecordingCache):
    """A cache that has one entry, and gives it for any key."""

    def _key(self, *_: Any) -> str:
        return seeds.CACHE_KEY


def _cache(data: bytes, folder: Path) -> None:
    _write(folder, f"{seeds.CACHE_KEY}.npz", data)
    recording = MessageRecording({"a": [Trigger(1.0)]})
    _OneEntry(folder).read(recording, "detections", {}, KEPT_TYPES)


def _names(data: bytes, folder: Path) -> None:
    """A folder of images with the names of the input's lines."""
    for line in data.decode(errors="replace").splitlines()[:20]:
        name = line.replace("/", "_").replace("\0", "_").encode()[:200].decode(errors="ignore")
        if name not in ("", ".", ".."):
            _write(folder, f"s/{name}", seeds.images()[0])
    with open_recording(folder) as recording:
        _inspect(recording)


_YAML_WORDS = (
    "*a",
    "&a ",
    "<<: ",
    "!!int ",
    "!!float ",
    "!!binary ",
    ".nan",
    ".inf",
    "1e300",
    "? ",
    "---\n",
    "|\n",
    "null",
)

HARNESSES: Mapping[str, Harness] = {
    "rig.yaml": Harness(
        _rig,
        lambda: [
            seeds.RIG, seeds.NETWORK, *seeds.written("rig.resolved.yaml")(),
            *(seeds.RIG.replace(b"family: tag36h11", b"pattern: " + p).partition(b"  tags:")[0] + b"sensors"
              + seeds.RIG.partition(b"sensors")[2] for p in seeds.PATTERNS),
        ],
        mutators.mutate_yaml,
        (*_YAML_WORDS, "kind: ", "board", "people", "cylinder", "pattern", "intrinsics", "uncertainty"),
    ),
    "settings": Harness(_settings, lambda: list(seeds.SETTINGS), None, (*_YAML_WORDS, "=", "captures.")),
    "target": Harness(
        _reads("target.yaml", read_boards), lambda: [seeds.RIG, seeds.NETWORK], mutators.mutate_yaml, _YAML_WORDS
    ),
    "calibration.yaml": Harness(
        _calibration,
        seeds.written("calibration.yaml", "short calibration.yaml"),
        mutators.mutate_yaml,
        _YAML_WORDS,
    ),
    "budget.csv": Harness(_budget, seeds.written("budget.csv"), None, ("nan", "inf", "1e999", '"', "\0", ",,")),
    "extrinsics": Harness(
        _extrinsics,
        lambda: [seeds.TRANSFORMS, seeds.URDF, *seeds.written("tf", "urdf")()],
        mutators.mutate_yaml,
        (*_YAML_WORDS, "<joint", "xyz=\"", "rpy=\"", "<!ENTITY", "<!DOCTYPE"),
    ),
    "URDF update": Harness(_urdf, lambda: [seeds.URDF, *seeds.written("urdf")()], None, ("<joint", "xyz=\"")),
    "truth.yaml": Harness(
        _reads("truth.yaml", load_truth), seeds.written("truth.yaml"), mutators.mutate_yaml, _YAML_WORDS
    ),
    "scenario": Harness(_scenario, lambda: list(seeds.SCENARIOS), mutators.mutate_yaml, _YAML_WORDS),
    "problem.npz": Harness(_reads("problem.npz", load_problem), seeds.written("problem.npz"), mutators.mutate_zip),
    "scene.npz": Harness(_scene, seeds.written("scene.npz"), mutators.mutate_zip),
    "cache": Harness(_cache, seeds.written("cache"), mutators.mutate_zip),
    "PCD": Harness(_file("s/1.0.pcd"), seeds.pcds, None, ("DATA ascii", "POINTS ", "COUNT ", "SIZE ")),
    "PCD, gzipped": Harness(_file("s/1.0.pcd.gz"), seeds.gzipped(seeds.pcds)),
    "PLY": Harness(_file("s/1.0.ply"), seeds.plys, None, ("property ", "element ", "double ", "list ")),
    "NPZ": Harness(_file("s/1.0.npz"), seeds.npzs, mutators.mutate_zip),
    "CSV scan": Harness(_file("s/1.0.csv"), lambda: [seeds.SCAN], None, ("nan", "inf", "1e300", "1_0")),
    "points as text": Harness(_file("s/1.0.xyz"), lambda: [seeds.POINTS], None, ("nan", "1e300", "x y z", "#")),
    "image": Harness(_file("s/1.0.png"), seeds.images),
    "names of files": Harness(_names, lambda: list(seeds.NAMES), None, ("cam0_", "1773380642", ".png", "_12")),
    "corners CSV": Harness(_file("xy.csv"), lambda: list(seeds.CORNERS), None, ("nan", "1e300", "frame_time")),
    "video, MKV": Harness(_file("a.mkv"), lambda: seeds.videos()[:1]),
    "video, MP4": Harness(_file("a.mp4"), lambda: seeds.videos()[1:2]),
    "video, AVI": Harness(_file("a.avi"), lambda: seeds.videos()[2:]),
    "camera_info.yaml": Harness(_camera_info, lambda: list(seeds.CAMERA_INFO), mutators.mutate_yaml, _YAML_WORDS),
    "metadata.yaml": Harness(_metadata, lambda: [seeds.METADATA], mutators.mutate_yaml, _YAML_WORDS),
    "ROS messages": Harness(_message, seeds.messages),
    "driver messages": Harness(_driver_message, seeds.driver_messages),
    "definitions": Harness(
        _definition,
        lambda: [bytes([28 + i % 4, 3]) + text for i, text in enumerate(seeds.DEFINITIONS)],
        None,
        ("[]", "[3]", "[<=3]", "string", "MSG: a/", "=" * 80 + "\n", "sequence<", "typedef ", "struct ", "@key "),
    ),
    "MCAP": Harness(_file("a.mcap"), seeds.mcaps, mutators.mutate_mcap),
    "MCAP, zstd": Harness(_file("a.mcap.zstd"), seeds.zstd_of(seeds.mcaps)),
    "SQLite": Harness(_file("a.db3"), seeds.databases),
    "ROS 1 bag": Harness(_file("a.bag"), seeds.bags1, mutators.mutate_bag1),
}  # fmt: skip
"""By the name of what they read."""
