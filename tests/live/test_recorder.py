"""The recorder loses no message, and what it wrote is readable whatever ends it."""

import asyncio
import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from calgraph.config.settings import LimitSettings, RecorderSettings
from calgraph.errors import InputError, RecordingError
from calgraph.io.yaml_reading import read_yaml
from calgraph.live.recorder import Recorder, make_cdr_schema
from calgraph.live.source import Channel, LiveMessage
from calgraph.live.state import RecorderState
from calgraph.recording import open_recording
from calgraph.recording.bags import BagRecording

STORE = get_typestore(Stores.ROS2_HUMBLE)
HEADER = Channel(
    "/calgraph/trigger",
    "std_msgs/msg/Header",
    "cdr",
    "ros2msg",
    "builtin_interfaces/Time stamp\nstring frame_id\n",
)
BYTES = Channel("/points", "test_msgs/msg/Bytes", "cdr", "ros2msg", "uint8[] data\n")
FREE = LimitSettings(min_free_disk=0)
USUAL = RecorderSettings()
SECOND = 10**9


def trigger(number: int) -> LiveMessage:
    time = STORE.types["builtin_interfaces/msg/Time"](sec=100 + number, nanosec=0)
    header = STORE.types["std_msgs/msg/Header"](stamp=time, frame_id=f"press {number}")
    return LiveMessage(HEADER, (100 + number) * SECOND, bytes(STORE.serialize_cdr(header, "std_msgs/msg/Header")))


def block(number: int, size: int) -> LiveMessage:
    data = b"\0\1\0\0" + size.to_bytes(4, "little") + bytes([number % 256]) * size
    return LiveMessage(BYTES, 100 * SECOND + number * 10**6, data)


def record(
    folder: Path, messages: list[LiveMessage], settings: RecorderSettings = USUAL, limits: LimitSettings = FREE
) -> RecorderState:
    async def run() -> RecorderState:
        recorder = Recorder(folder, settings, limits)
        try:
            for message in messages:
                await recorder.write(message)
        finally:
            await recorder.close()
        return recorder.state

    return asyncio.run(run())


def read(folder: Path) -> list[tuple[str, int]]:
    with open_recording(folder) as recording:
        return [(one.topic, round(one.arrival * 1e9)) for one in recording.records()]


def expected(messages: list[LiveMessage]) -> list[tuple[str, int]]:
    return sorted(((one.channel.topic, one.arrival) for one in messages), key=lambda pair: pair[1])


def test_messages_are_recorded_as_they_were_sent(tmp_path: Path) -> None:
    messages = [trigger(0), trigger(1), block(5000, 300)]
    record(tmp_path / "a session", messages)
    with open_recording(tmp_path / "a session") as recording:
        assert isinstance(recording, BagRecording)
        raw = list(recording.raw_messages([topic.name for topic in recording.topics]))
        assert [(one.topic, one.arrival, one.data) for one in raw] == [
            (one.channel.topic, one.arrival, one.data) for one in messages
        ]
        assert {one.definition.name for one in raw} == {"std_msgs/msg/Header", "test_msgs/msg/Bytes"}
        assert [one.stamp for one in recording.records([HEADER.topic])] == [100, 101]
        assert recording.notices == ()


def test_the_folder_is_one_that_the_tools_of_ros_read(tmp_path: Path) -> None:
    messages = [trigger(number) for number in range(3)]
    record(tmp_path / "bag", messages[:2])
    record(tmp_path / "bag", messages[2:])
    with Reader(tmp_path / "bag") as reader:
        assert [time for _, time, _ in reader.messages()] == [one.arrival for one in messages]
        assert reader.message_count == 3
        assert reader.duration == 2 * SECOND + 1
    information = read_yaml(tmp_path / "bag" / "metadata.yaml")["rosbag2_bagfile_information"]
    assert information["relative_file_paths"] == ["recording_0.mcap", "recording_1.mcap"]
    assert [file["message_count"] for file in information["files"]] == [2, 1]


def test_no_message_is_lost_at_20_megabytes_a_second_or_more(tmp_path: Path) -> None:
    messages = [block(number, 20_000) for number in range(1500)]
    state = record(tmp_path / "bag", messages, RecorderSettings(max_queued_bytes=10**6))
    assert read(tmp_path / "bag") == expected(messages)
    assert (state.messages, state.problem) == (1500, "")
    assert state.megabytes == pytest.approx(30, abs=0.5)
    assert state.seconds == pytest.approx(1.499)


def test_a_recording_without_messages_lasts_no_time(tmp_path: Path) -> None:
    state = record(tmp_path / "bag", [])
    assert (state.messages, state.seconds, state.problem) == (0, 0.0, "")


def test_messages_wait_while_the_disk_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A writer of messages is held up, and no memory fills, until the disk accepts what was queued."""
    monkeypatch.setattr("calgraph.live.recorder._MAX_CHUNK_BYTES", 20_000)
    accepts = threading.Event()
    sync = os.fsync

    def wait(descriptor: int) -> None:
        accepts.wait(60)
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", wait)
    messages = [block(number, 20_000) for number in range(50)]

    async def run() -> int:
        settings = RecorderSettings(max_queued_bytes=200_000)
        recorder = Recorder(tmp_path / "bag", settings, FREE)
        done = 0

        async def write() -> None:
            nonlocal done
            for message in messages:
                await recorder.write(message)
                done += 1

        writing = asyncio.create_task(write())
        while done < 10:
            await asyncio.sleep(0)
        for _ in range(200):
            await asyncio.sleep(0)
        held = done
        accepts.set()
        await writing
        await recorder.close()
        return held

    assert asyncio.run(run()) == 10
    assert read(tmp_path / "bag") == expected(messages)


_KILLED = """
import asyncio, sys
from pathlib import Path
sys.path[:0] = [{tests!r}, {source!r}]
from test_recorder import FREE, RecorderSettings, Recorder, block
async def run():
    recorder = Recorder(Path(sys.argv[1]), RecorderSettings(max_chunk_duration=0.02), FREE)
    number = 0
    while True:
        await recorder.write(block(number, 2000))
        number += 1
        # What is in the file now is what its reader has to find.
        print(recorder.state.messages, flush=True)
        await asyncio.sleep(0.001)
asyncio.run(run())
"""


def record_until_killed(folder: Path, moment: int) -> int:
    """How many messages the recorder had stated to be in its file when it was killed."""
    code = _KILLED.format(
        tests=str(Path(__file__).parent), source=str(Path(__file__).resolve().parents[2] / "src")
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(folder)], stdout=subprocess.PIPE, text=True, bufsize=1
    )
    assert process.stdout
    stated = 0
    for line in process.stdout:
        stated = int(line)
        if stated >= moment:
            process.kill()
            break
    stated = max([stated, *(int(line) for line in process.stdout if line.strip().isdigit())])
    assert process.wait() == -signal.SIGKILL
    process.stdout.close()
    return stated


def test_a_killed_recorder_leaves_what_it_stated_and_the_next_one_continues(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    stated = record_until_killed(folder, 40)
    before = read(folder)
    assert len(before) >= stated
    assert before == expected([block(number, 2000) for number in range(len(before))])
    assert not (folder / "metadata.yaml").exists()
    later = [block(number, 10) for number in range(10**6, 10**6 + 5)]
    record(folder, later)
    assert read(folder) == before + expected(later)
    with open_recording(folder) as recording:
        assert isinstance(recording, BagRecording)
        assert recording.notices == ()
    assert sorted(file.name for file in folder.iterdir()) == [
        "metadata.yaml", "recording_0.mcap", "recording_1.mcap",
    ]  # fmt: skip


def test_a_recording_ends_before_the_disk_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.live.recorder._MAX_CHUNK_BYTES", 10_000)
    free = [10**9]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free[0]))
    messages = [block(number, 2000) for number in range(100)]
    written: list[LiveMessage] = []

    async def run() -> RecorderState:
        settings = RecorderSettings()
        recorder = Recorder(tmp_path / "bag", settings, LimitSettings(min_free_disk=10**8))

        async def write() -> None:
            for number, message in enumerate(messages):
                if number == 40:
                    free[0] = 10**7
                await recorder.write(message)
                written.append(message)
                while number % 5 == 4 and recorder.state.messages <= number and not recorder.state.problem:
                    await asyncio.sleep(0)

        with pytest.raises(RecordingError, match=r"its disk is almost full: 100 MB are kept free"):
            await write()
        with pytest.raises(RecordingError, match="the recording has ended"):
            await recorder.close()
        return recorder.state

    state = asyncio.run(run())
    assert "almost full" in state.problem
    assert state.minutes_left == 0
    assert len(written) == 45
    assert read(tmp_path / "bag") == expected(written)
    with pytest.raises(InputError, match="its disk is almost full"):
        Recorder(tmp_path / "bag", RecorderSettings(), LimitSettings(min_free_disk=10**8))


def test_what_was_accepted_before_the_disk_was_full_is_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calgraph.live.recorder._MAX_CHUNK_BYTES", 10_000)
    free, go = [10**9], threading.Event()

    def measure(_: Path) -> Any:
        # The recorder waits at its first chunk, while all other messages are accepted.
        if threading.current_thread().name == "recorder":
            assert go.wait(60)
        return SimpleNamespace(free=free[0])

    monkeypatch.setattr(shutil, "disk_usage", measure)
    messages = [block(number, 2000) for number in range(100)]

    async def run() -> None:
        recorder = Recorder(tmp_path / "bag", RecorderSettings(), LimitSettings(min_free_disk=10**8))
        for message in messages:
            await recorder.write(message)
        free[0] = 10**7
        go.set()
        with pytest.raises(RecordingError, match="its disk is almost full"):
            await recorder.close()

    asyncio.run(run())
    assert read(tmp_path / "bag") == expected(messages)


def test_a_disk_that_cannot_be_written_to_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was written before can be read."""
    monkeypatch.setattr("calgraph.live.recorder._MAX_CHUNK_BYTES", 10_000)
    folder = tmp_path / "bag"

    async def run() -> int:
        recorder = Recorder(folder, RecorderSettings(), FREE)
        for number in range(5):
            await recorder.write(block(number, 2000))
        while recorder.state.messages < 5:
            await asyncio.sleep(0)
        before, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        # Of the next chunk 100 bytes are written.
        resource.setrlimit(resource.RLIMIT_FSIZE, (recorder.path.stat().st_size + 100, hard))
        try:
            for number in range(5, 10):
                await recorder.write(block(number, 2000))
            with pytest.raises(RecordingError, match=r"recording_0\.mcap: cannot be written to \(File too large"):
                await recorder.close()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (before, hard))
        return recorder.state.messages

    assert asyncio.run(run()) == 5
    assert read(folder) == expected([block(number, 2000) for number in range(5)])


def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"file/bag: cannot be written to \("):
        Recorder(tmp_path / "file" / "bag", RecorderSettings(), FREE)


def test_a_recording_without_messages_leaves_no_file(tmp_path: Path) -> None:
    record(tmp_path / "bag", [])
    assert list((tmp_path / "bag").iterdir()) == []


def ros1_messages() -> list[tuple[str, Any]]:
    types = get_typestore(Stores.ROS1_NOETIC).types
    header = types["std_msgs/msg/Header"](7, types["builtin_interfaces/msg/Time"](12, 500_000_000), "lidar")
    scan = types["sensor_msgs/msg/LaserScan"](
        header, -1.0, 1.0, 0.5, 0.0, 0.1, 0.1, 30.0, np.arange(5, dtype=np.float32), np.zeros(0, np.float32)
    )
    roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    info = types["sensor_msgs/msg/CameraInfo"](
        header, 480, 640, "plumb_bob", np.array([0.1, 0, 0, 0, 0.0]),
        np.array([500, 0, 320, 0, 500, 240, 0, 0, 1.0]), np.eye(3).ravel(), np.zeros(12), 0, 0, roi,
    )  # fmt: skip
    field = types["sensor_msgs/msg/PointField"]
    fields = [field(name, 4 * i, 7, 1) for i, name in enumerate("xyz")]
    points = np.arange(60, dtype="<f4").view(np.uint8)
    cloud = types["sensor_msgs/msg/PointCloud2"](header, 1, 20, fields, False, 12, 240, points, True)
    return [("sensor_msgs/msg/LaserScan", scan), ("sensor_msgs/msg/CameraInfo", info),
            ("sensor_msgs/msg/PointCloud2", cloud)]  # fmt: skip


def test_messages_of_ros_1_have_the_same_content_as_they_are_recorded(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    messages = []
    for number, (name, message) in enumerate(ros1_messages()):
        text, _ = store.generate_msgdef(name, ros_version=1)
        channel = Channel(f"/topic_{number}", name, "ros1", "ros1msg", text)
        messages.append(LiveMessage(channel, number * SECOND, bytes(store.serialize_ros1(message, name))))
    record(tmp_path / "bag", messages)
    with open_recording(tmp_path / "bag") as recording:
        contents: list[Any] = [one.decode() for one in recording.records()]
        assert [one.stamp for one in recording.records()] == [12.5] * 3
    scan, info, cloud = contents
    assert scan.frame_id == "lidar"
    np.testing.assert_array_equal(scan.ranges, [np.nan, 1, 2, 3, 4])
    np.testing.assert_allclose(info.camera.K, [[500, 0, 320], [0, 500, 240], [0, 0, 1]])
    np.testing.assert_array_equal(cloud.points.ravel(), np.arange(60))


def test_types_of_ros_1_that_ros_2_has_not_keep_their_fields() -> None:
    text = "Header header\nuint16 count\nfloat64[] values\ntime end\n"
    types = get_types_from_msg(
        f"{text}{'=' * 80}\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n", "my_msgs/msg/Own"
    )
    old = get_typestore(Stores.ROS1_NOETIC)
    old.register({"my_msgs/msg/Own": types["my_msgs/msg/Own"]})
    time = old.types["builtin_interfaces/msg/Time"]
    message = old.types["my_msgs/msg/Own"](
        old.types["std_msgs/msg/Header"](3, time(1, 2), "a"), 5, np.array([1.5, 2.5]), time(3, 4)
    )
    definition, _ = old.generate_msgdef("my_msgs/msg/Own", ros_version=1)
    schema = make_cdr_schema(Channel("/own", "my_msgs/msg/Own", "ros1", "ros1msg", definition))
    new = get_typestore(Stores.ROS2_HUMBLE)
    own = get_types_from_msg(schema.text, "my_msgs/msg/Own")
    assert own["std_msgs/msg/Header"][1] == new.fielddefs["std_msgs/msg/Header"][1]
    new.register({"my_msgs/msg/Own": own["my_msgs/msg/Own"]})
    raw = schema.convert(bytes(old.serialize_ros1(message, "my_msgs/msg/Own")))
    read_back: Any = new.deserialize_cdr(raw, "my_msgs/msg/Own")
    assert (read_back.header.frame_id, read_back.count, read_back.end.nanosec) == ("a", 5, 4)
    np.testing.assert_array_equal(read_back.values, [1.5, 2.5])


def test_messages_that_cannot_be_recorded_are_counted_and_others_are_recorded(tmp_path: Path) -> None:
    unknown = Channel("/odd", "my_msgs/msg/Unknown", "ros1", "ros1msg", "Other[ other")
    surrogate = Channel("/points", "test_msgs/msg/Bytes", "cdr", "ros2msg", "uint8[] data # \ud800\n")
    text, _ = get_typestore(Stores.ROS1_NOETIC).generate_msgdef("sensor_msgs/msg/LaserScan", ros_version=1)
    scans = Channel("/scan", "sensor_msgs/msg/LaserScan", "ros1", "ros1msg", text)
    messages = [
        LiveMessage(unknown, SECOND, b"1"),
        LiveMessage(unknown, SECOND, b"2"),
        LiveMessage(scans, SECOND, b"too short"),
        LiveMessage(HEADER, -1, trigger(0).data),
        LiveMessage(surrogate, SECOND, block(0, 1).data),
        trigger(0),
    ]
    state = record(tmp_path / "bag", messages)
    assert read(tmp_path / "bag") == expected(messages[-1:])
    problems = Counter(problem.partition(":")[0] for problem in state.problem.split("; "))
    assert problems == {"/odd": 1, "/scan": 1, "/calgraph/trigger": 1, "/points": 1}
    assert state.problem.startswith("/odd: 2 messages not recorded: the definition of type my_msgs/msg/Unknown is")
    assert "/calgraph/trigger: 1 message not recorded: it arrived at -1 ns, which is no time" in state.problem
