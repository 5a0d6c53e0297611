"""MCAPs of killed recorders and of copies that were cut off are read up to their last complete chunk."""

import io
import logging
import struct
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from calgraph.config.settings import LimitSettings
from calgraph.errors import RecordingError
from calgraph.recording import inspect_recording, open_recording
from calgraph.recording.bags import BagRecording
from calgraph.recording.unfinished_mcap import complete_mcap, finish_mcap
from mcap_records import pack_records, read_records

MAGIC = b"\x89MCAP0\r\n"
CHUNK, MESSAGE_INDEX, CHUNK_INDEX, DATA_END = 6, 7, 8, 15
TYPE = "std_msgs/msg/Header"
MESSAGES = 60
Read = list[tuple[str, float]]


def write(path: Path, *, size: int = 30, late: int = 3, **options: Any) -> Path:
    """An MCAP of chunks of 500 bytes with a message each 0.1 s on one topic, and each 0.3 s on another.

    The second topic is announced at the start, and its messages begin in a later chunk.
    """
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=500, **{"compression": CompressionType.NONE, **options})
        writer.start("ros2")
        schema = writer.register_schema(TYPE, "ros2msg", b"builtin_interfaces/Time stamp\nstring frame_id")
        channels = [writer.register_channel(name, "cdr", schema) for name in ("/a", "/b")]
        for i in range(MESSAGES):
            time = 10**9 + i * 10**8
            data = b"\0\1\0\0" + struct.pack("<iII", 1, i, size) + bytes(size)
            writer.add_message(channels[0], time, data, time)
            if i % 3 == 0 and i >= 10 * late:
                writer.add_message(channels[1], time, data, time)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def read(path: Path) -> Read:
    with open_recording(path) as recording:
        records = [(record.topic, record.arrival) for record in recording.records()]
        counts = {topic.name: topic.count for topic in recording.topics}
        assert all(counts[name] == sum(topic == name for topic, _ in records) for name in counts)
        return records


def records_of(path: Path) -> list[tuple[int, bytes]]:
    """The records of a complete MCAP up to its summary."""
    records = read_records(path.read_bytes()[8:-8])
    return records[: next(i for i, (op, _) in enumerate(records) if op == DATA_END)]


def end_of_chunk(path: Path, number: int) -> int:
    """Where a chunk ends, bytes."""
    records = records_of(path)
    at = [i for i, (op, _) in enumerate(records) if op == CHUNK][number]
    return 8 + len(pack_records(records[: at + 1]))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": CompressionType.ZSTD},
        {"compression": CompressionType.LZ4},
        {"index_types": IndexType.NONE},
        {"use_chunking": False},
    ],
    ids=str,
)
def test_a_file_cut_off_anywhere_is_read_as_far_as_it_goes(tmp_path: Path, options: dict[str, Any]) -> None:
    whole = write(tmp_path / "whole.mcap", **options)
    expected, content = read(whole), whole.read_bytes()
    lengths = []
    for size in range(len(content) // 3, len(content), len(content) // 37):
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(content[:size])
        lengths.append(len(records := read(cut)))
        assert records == expected[: len(records)]
    assert lengths == sorted(lengths)
    assert 5 < lengths[0] < len(expected) // 2
    assert lengths[-1] == len(expected)


def test_no_message_of_a_complete_chunk_is_lost(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole.mcap")
    cut = tmp_path / "cut.mcap"
    for number in (0, 1, 5):
        # A recorder is killed while it writes what follows the chunk: the index of its messages is missing.
        cut.write_bytes(whole.read_bytes()[: end_of_chunk(whole, number)])
        chunks = [content for op, content in records_of(whole) if op == CHUNK][: number + 1]
        last = struct.unpack_from("<8xQ", chunks[-1])[0] / 1e9
        assert read(cut) == [record for record in read(whole) if record[1] <= last]


def test_one_warning_names_the_file_and_how_far_it_is_read(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    whole = write(tmp_path / "whole.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: end_of_chunk(whole, 4) + 100])
    with caplog.at_level(logging.WARNING):
        last = read(cut)[-1][1]
    (warning,) = caplog.records
    assert warning.getMessage() == (
        f"{cut}: has no end, as its recorder was killed or its copy is incomplete: it is read up to the last "
        f"complete chunk, {last - 1:.2f} s after its first message"
    )


def test_the_inspection_states_that_the_end_is_missing(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: end_of_chunk(whole, 4)])
    for path, missing in ((whole, 0), (cut, 1)):
        with open_recording(path) as recording:
            inspection = inspect_recording(recording, lambda _: None)
        assert (len(inspection.notices), inspection.damage) == (missing, "")


def test_a_file_without_a_complete_chunk_is_refused(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: end_of_chunk(whole, 0) - 1])
    with pytest.raises(RecordingError, match=r"cut\.mcap: ends before its first chunk of messages is complete"):
        read(cut)


def test_metadata_that_state_more_messages_are_not_held_against_a_cut_off_file(tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    folder.mkdir()
    whole = write(folder / "recording_0.mcap")
    topics = "".join(
        f"    - {{topic_metadata: {{name: {name}, type: {TYPE}}}, message_count: 100}}\n" for name in ("/a", "/b")
    )
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  relative_file_paths: [recording_0.mcap]\n"
        f"  topics_with_message_count:\n{topics}"
    )
    expected, content = read(whole), whole.read_bytes()
    with pytest.raises(RecordingError, match="holds fewer messages than it states"):
        read(folder)
    whole.write_bytes(content[: end_of_chunk(whole, 6)])
    records = read(folder)
    assert records == expected[: len(records)]


def test_a_damaged_chunk_before_the_last_is_an_error(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole.mcap", compression=CompressionType.ZSTD)
    cut, end = bytearray(whole.read_bytes()[: end_of_chunk(whole, 6)]), end_of_chunk(whole, 3)
    cut[end - 20 : end] = bytes(20)
    whole.write_bytes(cut)
    with pytest.raises(RecordingError, match=r"whole\.mcap: "):
        read(whole)


def test_a_damaged_last_chunk_is_left_out(tmp_path: Path) -> None:
    """A system that lost its power has written the length of a chunk, but not its content."""
    whole = write(tmp_path / "whole.mcap")
    expected, end = read(whole), end_of_chunk(whole, 6)
    cut = bytearray(whole.read_bytes()[:end])
    cut[end - 20 : end] = bytes(20)
    whole.write_bytes(cut)
    records = read(whole)
    assert records == expected[: len(records)]
    assert len(records) > 20


def test_space_that_was_reserved_and_not_written_is_no_damage(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole.mcap")
    expected, kept = read(whole), whole.read_bytes()[: end_of_chunk(whole, 6)]
    whole.write_bytes(kept + bytes(10_000))
    records = read(whole)
    assert records == expected[: len(records)]
    assert len(records) > 20
    whole.write_bytes(kept + bytes(9_000) + b"\6" * 1000)
    with pytest.raises(RecordingError, match=f"has no record at byte {len(kept)}: it is damaged there"):
        read(whole)


def test_a_damaged_length_is_not_taken_for_the_end(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole.mcap")
    content = bytearray(whole.read_bytes()[: end_of_chunk(whole, 6)])
    chunk = [content for op, content in records_of(whole) if op == CHUNK][3]
    start = end_of_chunk(whole, 3) - len(chunk) - 9
    content[start + 6] = 1  # of eight bytes of its length
    whole.write_bytes(content)
    with pytest.raises(RecordingError, match=f"chunk at byte {start} states contradictory lengths"):
        read(whole)


def test_chunks_are_checked_before_they_are_unpacked(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole.mcap", size=3000, compression=CompressionType.ZSTD)
    whole.write_bytes(whole.read_bytes()[: end_of_chunk(whole, 1)])
    with pytest.raises(RecordingError, match=r"unpacks to more than the limit of 0 MB"):
        open_recording(whole, LimitSettings(max_unpacked_bytes=2000))


def test_chunks_are_passed_over(tmp_path: Path) -> None:
    class CountingFile(io.FileIO):
        count = 0

        def readinto(self, buffer: Any) -> int:
            n = super().readinto(buffer) or 0
            self.count += n
            return n

    whole = write(tmp_path / "whole.mcap", size=300_000, late=0)
    whole.write_bytes(whole.read_bytes()[: end_of_chunk(whole, -1)])
    with CountingFile(whole) as file, io.BufferedReader(file, 4096) as buffered:
        complete_mcap(buffered, LimitSettings())
        # The first and the last chunk are read, and the heads of 78 others.
        assert file.count < 0.06 * whole.stat().st_size


def test_files_of_several_runs_are_one_recording(tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    folder.mkdir()
    first, second = (write(folder / f"recording_{i}.mcap", late=i) for i in range(2))
    expected = sorted(read(first) + read(second), key=lambda record: record[1])
    assert len(read(folder)) == len(expected)
    first.write_bytes(first.read_bytes()[: end_of_chunk(first, 8)])
    assert sorted(read(folder)) == sorted(read(first) + read(second))


@pytest.mark.parametrize("options", [{}, {"use_chunking": False}], ids=str)
def test_a_finished_file_is_an_ordinary_one_with_the_same_messages(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    whole = write(tmp_path / "whole.mcap", **options)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:3000])
    expected = read(cut)
    finish_mcap(cut, LimitSettings())
    with cut.open("rb") as file:
        messages = [(channel.topic, m.log_time / 1e9) for _, channel, m in make_reader(file).iter_messages()]
    assert messages == expected
    content = cut.read_bytes()
    for index in (index for op, index in read_records(content[8:-8]) if op == CHUNK_INDEX):
        chunk, length, entries = struct.unpack_from("<16xQQI", index)
        (size,) = struct.unpack_from("<Q", index, 36 + entries)
        indices = [record for op, record in read_records(content[chunk + length :][:size]) if op == MESSAGE_INDEX]
        assert len(indices) == entries // 10
        for channel, _, time, offset in (struct.unpack_from("<HIQQ", one) for one in indices):
            message = content[chunk + 9 + 40 + offset :]
            assert struct.unpack_from("<BQH4xQ", message)[::2] == (5, channel)
            assert struct.unpack_from("<BQH4xQ", message)[3] == time
    with open_recording(cut) as recording:
        assert [(record.topic, record.arrival) for record in recording.records()] == expected
        assert isinstance(recording, BagRecording)
        assert recording.notices == ()


def test_a_complete_file_needs_no_finish(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole.mcap")
    content = whole.read_bytes()
    finish_mcap(whole, LimitSettings())
    assert whole.read_bytes() == content
