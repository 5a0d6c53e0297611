"""Calls that read the messages of their holds themselves find what those find to which the messages are sent."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from calgraph.config import Board, Lidar2dSpec, Rig, Tag
from calgraph.errors import RecordingError
from calgraph.parallel.engine import THIS_PROCESS, Processes
from calgraph.recording import (
    NO_CACHE,
    ClockCorrectedRecording,
    MessageRecording,
    PoseRecordings,
    Recording,
    RecordingWriter,
    open_recording,
    open_recordings,
)
from calgraph.rig.captures.hold_messages import Messages, search_holds, select_messages
from calgraph.rig.captures.holds import Hold
from calgraph.rig.captures.timeline import RecordingTimeline, build_timeline
from calgraph.rig.captures.timeline_reading import measure_activity
from calgraph.sensors import LaserScan, Message
from engines import PicklingEngine
from videos import write_video

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

RIG = Rig(
    root="a",
    target=Board(size=(1, 1), tags=(Tag(id=0, size=0.5),)),
    sensors={name: Lidar2dSpec(kind="lidar2d", topic=name) for name in "ab"},
)
BEAMS = 400
Found = tuple[str, int, str, list[list[float]]]
Measured = list[tuple[str, LaserScan, float]]
"""Topic, scan and arrival."""


@pytest.fixture
def measured(rng: np.random.Generator) -> Measured:
    """Two scanners; scans arrive late, some of them before earlier ones, and one stamp is there twice."""
    angles = np.linspace(-1, 1, BEAMS)
    found: Measured = []
    for topic, rate in (("a", 10.0), ("b", 15.0)):
        stamps = 1.7e9 + np.arange(0, 20, 1 / rate)
        stamps[31] = stamps[30]
        arrivals = stamps + rng.uniform(0.01, 0.3, len(stamps))
        for stamp, arrival in zip(stamps.tolist(), arrivals.tolist(), strict=True):
            found.append((topic, LaserScan(stamp, topic, angles, rng.uniform(1, 5, BEAMS)), arrival))
    return sorted(found, key=lambda one: one[2])


def write(path: Path, measured: Measured, **options: Any) -> Path:
    with RecordingWriter(path, **options) as writer:
        for topic, scan, arrival in measured:
            writer.write(topic, scan, arrival)
    return path


def rewrite(path: Path, measured: Measured, writer: Writer) -> Path:
    """Copies a recording to one that another writer makes."""
    with Reader(write(path / "first", measured)) as reader, writer:
        copies = {
            one.id: writer.add_connection(
                one.topic, one.msgtype, msgdef=one.msgdef.data, rihs01="RIHS01_" + 64 * "0"
            )
            for one in reader.connections
        }
        for connection, arrival, data in reader.messages():
            writer.write(copies[connection.id], arrival, data)
    return writer.path


def as_mcap(path: Path, measured: Measured) -> list[Path]:
    return [write(path / "bag", measured)]


def as_split_mcap(path: Path, measured: Measured) -> list[Path]:
    return [write(path / "bag", measured, max_file_duration=3.0)]


def as_several(path: Path, measured: Measured) -> list[Path]:
    return [write(path / topic, [one for one in measured if one[0] == topic]) for topic in "ab"]


def as_mcap_with_compressed_chunks(path: Path, measured: Measured) -> list[Path]:
    writer = Writer(path / "bag", version=8, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    return [rewrite(path, measured, writer)]


def as_compressed_messages(path: Path, measured: Measured) -> list[Path]:
    writer = Writer(path / "bag", version=8, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    return [rewrite(path, measured, writer)]


def as_database(path: Path, measured: Measured) -> list[Path]:
    return [rewrite(path, measured, Writer(path / "bag", version=8, storage_plugin=StoragePlugin.SQLITE3))]


def as_ros1_bag(path: Path, measured: Measured) -> list[Path]:
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Reader(write(path / "first", measured)) as reader, Writer1(path / "old.bag") as writer:
        old = get_typestore(Stores.ROS1_NOETIC)
        copies = {
            one.id: writer.add_connection(one.topic, one.msgtype, typestore=old) for one in reader.connections
        }
        for connection, arrival, data in reader.messages():
            writer.write(copies[connection.id], arrival, store.cdr_to_ros1(data, connection.msgtype))
    return [path / "old.bag"]


def as_folder(path: Path, measured: Measured) -> list[Path]:
    """Files arrive at their stamps, and each has another one."""
    for topic, scan, _ in measured:
        (path / "files" / topic).mkdir(parents=True, exist_ok=True)
        np.savez(
            path / "files" / topic / f"{scan.stamp:.6f}.npz",
            ranges=scan.ranges,
            angle_min=-1.0,
            angle_increment=0.01,
        )
    return [path / "files"]


def open_with_offset(paths: Sequence[Path]) -> Recording:
    return ClockCorrectedRecording(open_recordings(paths), {"b": 1.2345678})


def open_numbered(path: Path, measured: Measured) -> Recording:
    """Files that are named by the numbers of poses, for which arrivals are corrected, too."""
    for topic, scan, _ in measured[:60]:
        (path / "files" / topic).mkdir(parents=True, exist_ok=True)
        number = len(list((path / "files" / topic).iterdir()))
        np.savez(
            path / "files" / topic / f"{number}.npz", ranges=scan.ranges, angle_min=-1.0, angle_increment=0.01
        )
    return open_with_offset([path / "files"])


def describe(
    shared: str, capture: int, name: str, decoders: Sequence[Callable[[], Message]], _size: None
) -> Found:
    """What was searched."""
    messages = [decode() for decode in decoders]
    return shared, capture, name, [m.ranges.tolist() for m in messages if isinstance(m, LaserScan)]


def read_timeline_of(recording: Recording) -> RecordingTimeline:
    return build_timeline(recording.records("ab"), recording.start, RIG.topics, None)


def make_holds(timeline: RecordingTimeline) -> list[Hold]:
    """Holds that follow each other and overlap, one that only one sensor measured, and one without messages."""
    a, b = (timeline.sensors[name].stamps for name in "ab")
    holds = [
        Hold(0, 0.0, 0.0, {"a": a[k : k + 8], "b": b[k : k + 12]}) for k in range(0, min(len(a), len(b)) - 12, 6)
    ]
    holds += [Hold(0, 0.0, 0.0, {"a": a[::9], "b": b[:0]}), Hold(0, 0.0, 0.0, {"a": a[:0], "b": b[:0]})]
    return [Hold(index, 0.0, 0.0, hold.stamps) for index, hold in enumerate(holds)]


def compare(recording: Recording) -> None:
    """Checks that what calls read themselves is what they get otherwise, and that little is sent to them."""
    timeline, engine = read_timeline_of(recording), PicklingEngine()
    holds, stored = make_holds(timeline), select_messages(RIG, recording, timeline, engine)
    assert stored is not None

    def search(messages: Messages, engine: Any, skipped: Sequence[tuple[int, str]] = ()) -> list[Found]:
        found = search_holds(describe, "shared", messages, holds, RIG.topics, engine=engine, skipped=skipped)
        return sorted(found)

    expected = search(recording.records("ab"), THIS_PROCESS)
    assert len(expected) == 2 * len(holds)
    assert search(stored, engine) == expected
    assert 3 <= len(engine.sent) <= 9
    assert sum(engine.sent) < 0.1 * sum(len(ranges) * 8 for one in expected for ranges in one[3])
    skipped = [(hold.index, name) for hold in holds[2:] for name in "ab" if (hold.index, name) != (7, "b")]
    assert search(stored, engine, skipped) == [one for one in expected if one[1:3] not in skipped]

    once, parts = (
        measure_activity(timeline, RIG, recording, NO_CACHE, lambda _arrival: None, used)
        for used in (THIS_PROCESS, engine)
    )
    for name in "ab":
        assert once.sensors[name].activity.any()
        assert parts.sensors[name].activity.tobytes() == once.sensors[name].activity.tobytes()


@pytest.mark.parametrize(
    "store",
    [
        as_mcap, as_split_mcap, as_several, as_mcap_with_compressed_chunks, as_compressed_messages, as_database,
        as_ros1_bag, as_folder,
    ],
)  # fmt: skip
@pytest.mark.parametrize("open_paths", [open_recordings, open_with_offset])
def test_calls_read_the_same_messages_as_they_would_get(
    store: Callable[[Path, Measured], list[Path]],
    open_paths: Callable[[Sequence[Path]], Recording],
    measured: Measured,
    tmp_path: Path,
) -> None:
    with open_paths(store(tmp_path, measured)) as recording:
        compare(recording)


def test_calls_read_files_that_are_named_by_numbers(measured: Measured, tmp_path: Path) -> None:
    with open_numbered(tmp_path, measured) as recording:
        compare(recording)


def test_calls_read_a_recording_at_a_url(measured: Measured, tmp_path: Path) -> None:
    (path,) = as_mcap(tmp_path, measured)
    with open_recordings([path.as_uri()]) as recording:
        compare(recording)


def test_a_damaged_message_is_reported_as_it_is_where_messages_are_sent(
    measured: Measured, tmp_path: Path
) -> None:
    (folder,) = as_folder(tmp_path, measured)
    damaged = sorted((folder / "a").iterdir())[70]
    damaged.write_bytes(b"no scan")
    with open_recordings([folder]) as recording:
        timeline, engine = read_timeline_of(recording), PicklingEngine()
        holds, errors = make_holds(timeline), []
        for messages in (recording.records("ab"), select_messages(RIG, recording, timeline, engine)):
            assert messages is not None
            with pytest.raises(RecordingError, match=f"{damaged.name}: topic a, stamp") as raised:
                list(search_holds(describe, "", messages, holds, RIG.topics, engine=engine))
            errors.append(str(raised.value))
        for used in (THIS_PROCESS, engine):
            with pytest.raises(RecordingError) as raised:
                measure_activity(timeline, RIG, recording, NO_CACHE, lambda _arrival: None, used)
            errors.append(str(raised.value))
    assert len(set(errors)) == 1


def test_processes_of_this_machine_get_messages(measured: Measured, tmp_path: Path) -> None:
    with open_recordings(as_mcap(tmp_path, measured)) as recording:
        assert select_messages(RIG, recording, read_timeline_of(recording), Processes(4)) is None


def as_compressed_file(path: Path, measured: Measured) -> Recording:
    (file,) = write(path / "bag", measured).glob("*.mcap")
    (path / "packed.mcap.zstd").write_bytes(zstd.compress(file.read_bytes()))
    return open_recording(path / "packed.mcap.zstd")


def as_unfinished_file(path: Path, measured: Measured) -> Recording:
    (file,) = write(path / "bag", measured).glob("*.mcap")
    (path / "cut.mcap").write_bytes(file.read_bytes()[:-2000])
    return open_recording(path / "cut.mcap")


def as_video(path: Path, measured: Measured) -> Recording:
    (folder,) = as_folder(path, measured[:20])
    write_video(folder / "c.mp4", 5 * [np.zeros((48, 64, 3), np.uint8)], [0.1 * k for k in range(5)])
    return open_recording(folder)


def as_poses(path: Path, measured: Measured) -> Recording:
    return PoseRecordings([open_recording(write(path / f"{k}", measured)) for k in range(2)], "ab", 1.0)


def in_memory(_path: Path, measured: Measured) -> Recording:
    return MessageRecording({topic: [scan for name, scan, _ in measured if name == topic] for topic in "ab"})


@pytest.mark.parametrize("store", [as_compressed_file, as_unfinished_file, as_video, as_poses, in_memory])
def test_calls_get_the_messages_of_what_cannot_be_read_in_parts(
    store: Callable[[Path, Measured], Recording], measured: Measured, tmp_path: Path
) -> None:
    with store(tmp_path, measured) as recording:
        assert select_messages(RIG, recording, read_timeline_of(recording), PicklingEngine()) is None
