"""What is fuzzed: each harness gives bytes to one of calgraph's readers as a file, and uses what it returns.

The property: it returns, or raises one of calgraph's own errors. Where checksums or compression would stop most
mutations, the bytes are those within, and the harness packs them into a file. YAML is also mutated as a tree.
"""

import gzip
import json
import struct
import warnings
import zipfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from io import BytesIO
from itertools import islice
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

from backports import zstd
from rosbags.interfaces import MessageDefinitionFormat
from ruamel.yaml import YAML

import reader_seeds as seeds
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
_MAX_MEMBER = 20_000
"""Bytes of a member of an archive that is a seed: larger ones are slow, and find the same."""
_VALUES: tuple[Any, ...] = (
    0, 1, -1, 2, 0.5, -0.0, 1e-300, 1e300, float("nan"), float("inf"), 2**31, 2**63, -(2**63), 10**30, 255, 65536,
    None, True, False, "", "a", "camera", "lidar", "\x00", "\u2028", "a" * 300, "=1+1", "board", "people", [], {},
    [0], [1, 2, 3], {"a": 1}, {"kind": "board"}, [[]], "2001-01-01", "nan", "1 mm", "0.3 deg",
)  # fmt: skip
"""That take the place of others in trees."""
_ACTIONS = 4
"""What is done with a member of an archive: other content, removed, repeated, or the name of another."""

Run = Callable[[bytes, Path], None]
MutateBytes = Callable[[bytes], bytes]
Mutate = Callable[[bytes, Random, MutateBytes], bytes]
"""Changes an input, by a generator of random numbers and the fuzzer's own mutation of bytes."""


@dataclass(frozen=True)
class Harness:
    """One reader."""

    run: Run
    """Gives the bytes to the reader; the folder is empty, and its content is removed afterwards."""
    seeds: seeds.Seeds
    words: tuple[str, ...] = ()
    """Of the reader's language, for mutations of bytes."""
    mutate: Mutate | None = None


def mutate_yaml(data: bytes, rng: Random, inner: MutateBytes) -> bytes:
    """Values and keys of a YAML file, or its text."""
    if rng.random() < 0.4:
        return inner(data)
    try:
        content = YAML(typ="safe").load(data)
    except Exception:  # no YAML any more
        return inner(data)
    text = json.dumps(_name_keys(mutate_tree(content, rng)), default=str)
    return text.replace("Infinity", ".inf").replace("NaN", ".nan").encode()


def _name_keys(content: Any) -> Any:
    """The same with keys that JSON allows: YAML also has keys that are dates, bytes and tuples."""
    if isinstance(content, dict):
        plain = bool, int, float, str, type(None)
        return {key if isinstance(key, plain) else str(key): _name_keys(one) for key, one in content.items()}
    return [_name_keys(one) for one in content] if isinstance(content, list) else content


def mutate_tree(content: Any, rng: Random) -> Any:
    """Nested lists and mappings with one place changed."""
    if content and isinstance(content, dict | list) and rng.random() < 0.9:
        items: list[tuple[Any, Any]] = list(enumerate(content) if isinstance(content, list) else content.items())
        i, roll = rng.randrange(len(items)), rng.random()
        key, value = items[i]
        if roll < 0.08:
            items.pop(i)
        elif roll < 0.12:
            items.append((rng.choice(("kind", "a", str(key)[:-1])), value))
        elif roll < 0.16:
            items[i] = key, rng.choice(items)[1]
        else:
            items[i] = key, mutate_tree(value, rng)
        return [one for _, one in items] if isinstance(content, list) else dict(items)
    if isinstance(content, int | float) and rng.random() < 0.5:
        return rng.choice((content * 1000, -content, content + 1, content / 1000, content * (1 + 1e-9)))
    return rng.choice(_VALUES)


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


def _reads(name: str, read: Callable[[Path], object]) -> Run:
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
        content = seeds.written_files()["calibration.yaml"]
        return load_calibration(_write(Path(folder), "calibration.yaml", content))


def _urdf(data: bytes, _folder: Path) -> None:
    export(_calibration_of_seeds(), "urdf", urdf=data.decode(errors="replace"))


def _scenario(data: bytes, folder: Path) -> None:
    path = _write(folder, "scenario.yaml", data)
    content = read_yaml(path)
    validate_content(NetworkScenario if "scanner" in content else RigScenario, content, path)


def _scene(path: Path) -> None:
    for snapshot in load_scene(path).snapshots[:3]:
        _ = snapshot.picture


def _archive(name: str, read: Callable[[Path], object], archives: seeds.Seeds) -> Harness:
    """Of ZIPs: two bytes state what is done with which member; its content follows."""

    @cache
    def members() -> list[list[tuple[str, bytes]]]:
        found = []
        for data in archives():
            with zipfile.ZipFile(BytesIO(data)) as archive:
                found.append([(one, archive.read(one)) for one in archive.namelist()])
        return found

    def run(data: bytes, folder: Path) -> None:
        what, which = data[:2].ljust(2, b"\0")
        number, action = divmod(what, _ACTIONS)
        contents = list(members()[number % len(members())])
        i = which % len(contents)
        member = contents[i][0]
        match action:
            case 0:
                contents[i] = member, data[2:]
            case 1:
                contents.pop(i)
            case 2:
                contents.append((member, data[2:]))
            case _:
                other = data[2] % len(contents) if len(data) > 2 else 0
                contents[i] = contents[other][0], contents[i][1]
        path = _write(folder, name, b"")
        with zipfile.ZipFile(path, "w") as archive, warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of members that have the same name
            for one, content in contents:
                archive.writestr(zipfile.ZipInfo(one), content)
        read(path)

    def make_seeds() -> list[bytes]:
        found = []
        for number, contents in enumerate(members()):
            first = _ACTIONS * number
            found += [bytes([first, i]) + one for i, (_, one) in enumerate(contents) if len(one) < _MAX_MEMBER]
            found += [bytes([first + 1, 0]), bytes([first + 2, 0]), bytes([first + 3, 0, 1])]
        return found

    return Harness(run, make_seeds)


def _ignore(_: float) -> None:
    pass


def _inspect(recording: Recording) -> None:
    format_json(asdict(inspect_recording(recording, _ignore)))
    for record in islice(recording.records(), _MAX_RECORDS):
        record.decode()
        if record.digest:
            record.digest()
    draft_rig(find_topics(recording), "recording")


def _read_recording(path: Path) -> None:
    with open_recording(path) as recording:
        _inspect(recording)


def _file(name: str) -> Run:
    """A recording of this one file."""

    def run(data: bytes, folder: Path) -> None:
        _write(folder, name, data)
        _read_recording(folder if "/" in name else folder / name)

    return run


def _chunk(data: bytes, folder: Path) -> None:
    """Records of a chunk of an MCAP without a summary (mcap.dev/spec); the first byte states its unpacked size."""
    what, data = data[:1], data[1:]
    size = (0, 1, len(data) + 1, 2**40, 2**63)[what[0] - 251] if what and what[0] > 250 else len(data)
    chunk = struct.pack("<QQQIIQ", 0, 2**62, size, 0, 0, len(data)) + data
    records = ((6, chunk), (15, bytes(4)), (2, bytes(20)))
    content = b"".join(struct.pack("<BQ", op, len(one)) + one for op, one in records)
    _file("a.mcap")(seeds.MCAP_MAGIC + struct.pack("<BQ", 1, 8) + bytes(8) + content + seeds.MCAP_MAGIC, folder)


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


def _cache(path: Path) -> None:
    recording = MessageRecording({"a": [Trigger(1.0)]})
    _OneEntry(path.parent).read(recording, "detections", {}, KEPT_TYPES)


def _names(data: bytes, folder: Path) -> None:
    """A folder of images with the names of the input's lines."""
    for line in data.decode(errors="replace").splitlines()[:20]:
        name = line.replace("/", "_").replace("\0", "_").encode()[:200].decode(errors="ignore")
        if name not in ("", ".", ".."):
            _write(folder, f"s/{name}", seeds.images()[0])
    with open_recording(folder) as recording:
        _inspect(recording)


_YAML_WORDS = (
    "*a", "&a ", "<<: ", "!!int ", "!!float ", "!!binary ", ".nan", ".inf", "1e300", "? ", "---\n", "|\n", "null",
)  # fmt: skip


def _yaml(run: Run, make_seeds: seeds.Seeds, *words: str) -> Harness:
    return Harness(run, make_seeds, (*_YAML_WORDS, *words), mutate_yaml)


HARNESSES: Mapping[str, Harness] = {
    "rig.yaml": _yaml(_rig, seeds.rigs, "kind: ", "board", "people", "cylinder", "pattern", "intrinsics"),
    "settings": Harness(_settings, lambda: list(seeds.SETTINGS), (*_YAML_WORDS, "=", "captures.")),
    "target": _yaml(_reads("target.yaml", read_boards), lambda: [seeds.RIG, seeds.NETWORK]),
    "calibration.yaml": _yaml(_calibration, seeds.written("calibration.yaml", "short calibration.yaml")),
    "budget.csv": Harness(_budget, seeds.written("budget.csv"), ("nan", "inf", "1e999", '"', "\0", ",,")),
    "extrinsics": _yaml(
        _extrinsics, lambda: [seeds.TRANSFORMS, seeds.URDF, *seeds.written("tf", "urdf")()],
        "<joint", 'xyz="', 'rpy="', "<!ENTITY", "<!DOCTYPE",
    ),
    "URDF update": Harness(_urdf, lambda: [seeds.URDF, *seeds.written("urdf")()], ("<joint", 'xyz="')),
    "truth.yaml": _yaml(_reads("truth.yaml", load_truth), seeds.written("truth.yaml")),
    "scenario": _yaml(_scenario, lambda: list(seeds.SCENARIOS)),
    "problem.npz": _archive("problem.npz", load_problem, seeds.written("problem.npz")),
    "scene.npz": _archive("scene.npz", _scene, seeds.written("scene.npz")),
    "cache": _archive(f"{seeds.CACHE_KEY}.npz", _cache, seeds.written(f"{seeds.CACHE_KEY}.npz")),
    "PCD": Harness(_file("s/1.0.pcd"), seeds.pcds, ("DATA ascii", "POINTS ", "COUNT ", "SIZE ")),
    "PCD, gzipped": Harness(_file("s/1.0.pcd.gz"), lambda: list(map(gzip.compress, seeds.pcds()))),
    "PLY": Harness(_file("s/1.0.ply"), seeds.plys, ("property ", "element ", "double ", "list ")),
    "NPZ": Harness(_file("s/1.0.npz"), seeds.npzs),
    "NPZ, members": _archive("s/1.0.npz", lambda path: _read_recording(path.parents[1]), seeds.npzs),
    "CSV scan": Harness(_file("s/1.0.csv"), lambda: [seeds.SCAN], ("nan", "inf", "1e300", "1_0")),
    "points as text": Harness(_file("s/1.0.xyz"), lambda: [seeds.POINTS], ("nan", "1e300", "x y z", "#")),
    "image": Harness(_file("s/1.0.png"), seeds.images),
    "names of files": Harness(_names, lambda: list(seeds.NAMES), ("cam0_", "1773380642", ".png", "_12")),
    "corners CSV": Harness(_file("xy.csv"), lambda: list(seeds.CORNERS), ("nan", "1e300", "frame_time")),
    "video, MKV": Harness(_file("a.mkv"), lambda: [seeds.video("mkv", "mpeg4")]),
    "video, MP4": Harness(_file("a.mp4"), lambda: [seeds.video("mp4", "mpeg4")]),
    "video, AVI": Harness(_file("a.avi"), lambda: [seeds.video("avi", "mjpeg")]),
    "camera_info.yaml": _yaml(_camera_info, lambda: list(seeds.CAMERA_INFO)),
    "metadata.yaml": _yaml(_metadata, lambda: [seeds.METADATA]),
    "ROS messages": Harness(_message, seeds.messages),
    "driver messages": Harness(_driver_message, seeds.driver_messages),
    "definitions": Harness(
        _definition, lambda: [bytes([28 + i % 4, 3]) + text for i, text in enumerate(seeds.DEFINITIONS)],
        ("[]", "[3]", "[<=3]", "string", "MSG: a/", "=" * 80 + "\n", "sequence<", "typedef ", "struct ", "@key "),
    ),
    "MCAP": Harness(_file("a.mcap"), seeds.mcaps),
    "MCAP, chunk": Harness(_chunk, seeds.chunks),
    "MCAP, zstd": Harness(_file("a.mcap.zstd"), lambda: list(map(zstd.compress, seeds.mcaps()))),
    "SQLite": Harness(_file("a.db3"), seeds.databases),
    "ROS 1 bag": Harness(_file("a.bag"), seeds.bags1),
}  # fmt: skip
"""By the name of what they read."""
