"""The files of a recording that is made in several runs: a rosbag2 folder, as the tools of ROS 2 read it."""

import os
import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from rosbags.interfaces import Connection

from calgraph.config.settings import LimitSettings
from calgraph.io.text_writing import save_yaml
from calgraph.recording.chunk_limits import open_reader
from calgraph.recording.unfinished_mcap import finish_mcap

METADATA = "metadata.yaml"
_PART = ".part"
_NAME = re.compile(rf"recording_(\d+)\.mcap({re.escape(_PART)})?")
# Of the format of metadata.yaml, as ROS 2 Iron and later write and read it.
_METADATA_VERSION = 8


@dataclass(frozen=True)
class RecordedFile:
    """A file of a recording."""

    path: Path
    start: int
    """Arrival of its first message, ns; likewise the last."""
    end: int
    connections: tuple[Connection, ...]

    @property
    def count(self) -> int:
        """Messages."""
        return sum(connection.msgcount for connection in self.connections)


class ChunkFile:
    """A new file of a recording, to which an MCAP's writer writes; what is flushed is written whole or not at all.

    It gets its name when it is flushed first, so that no file of the recording is without a message.

    Raises:
        OSError: the file cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        numbers = [int(match[1]) for file in folder.iterdir() if (match := _NAME.fullmatch(file.name))]
        self.path = folder / f"recording_{max(numbers, default=-1) + 1}.mcap"
        self._part = self.path.with_name(self.path.name + _PART)
        self._file = self._part.open("xb", buffering=0)
        self._pending: list[bytes] = []
        self._position = 0
        self.size = 0
        """What has been flushed, bytes."""

    @property
    def is_empty(self) -> bool:
        """Whether nothing has been flushed."""
        return self.size == 0

    def write(self, data: bytes | bytearray | memoryview) -> int:
        """Takes bytes, which the next flush writes."""
        copied = bytes(data)
        self._pending.append(copied)
        self._position += len(copied)
        return len(copied)

    def tell(self) -> int:
        """Where the next bytes will be."""
        return self._position

    def flush(self) -> None:
        """Writes what was taken.

        Raises:
            OSError: it cannot be written; the file is as it was before.
        """
        rest = memoryview(b"".join(self._pending))
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError:
            with suppress(OSError):
                self._file.truncate(self.size)
            raise
        self._pending.clear()
        if self.is_empty:
            self._part.rename(self.path)
            _sync_folder(self.path.parent)
        self.size = self._position

    def sync(self) -> None:
        """Has the disk store what was flushed."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Closes the file, and removes it if nothing was flushed."""
        self._file.close()
        if self.is_empty:
            self._part.unlink()


def finish_files(folder: Path, limits: LimitSettings) -> None:
    """Gives files an end that lack it, as their recorder was killed; damaged ones stay as they are.

    Raises:
        OSError: a file cannot be written.
    """
    for file in _list_files(folder):
        if file.suffix == _PART and not file.stat().st_size:  # killed before its first message
            file.unlink()
            continue
        try:
            finish_mcap(file, limits)
        except OSError:
            raise
        except Exception:  # of many kinds where bytes are damaged; its reader reports them
            continue
        # The system may have forgotten the new name of a file when it lost its power.
        file.rename(file.with_name(file.name.removesuffix(_PART)))


def read_files(folder: Path, limits: LimitSettings) -> tuple[RecordedFile, ...]:
    """The files with messages, in the order of their recording.

    Raises:
        Exception: anything that rosbags raises for damaged bytes.
    """
    files = []
    for path in _list_files(folder):
        if path.suffix != _PART:
            reader = open_reader(path, limits)
            files.append(RecordedFile(path, reader.start_time, reader.end_time - 1, tuple(reader.connections)))
            reader.close()
    return tuple(files)


def write_metadata(folder: Path, files: Sequence[RecordedFile]) -> None:
    """Writes metadata.yaml, which the tools of ROS 2 expect.

    Raises:
        InputError: it cannot be written.
    """
    start, end = min(file.start for file in files), max(file.end for file in files)
    counts: Counter[tuple[str, str]] = Counter()
    for file in files:
        for connection in file.connections:
            counts[connection.topic, connection.msgtype] += connection.msgcount
    content = {
        "version": _METADATA_VERSION,
        "storage_identifier": "mcap",
        "duration": {"nanoseconds": end - start},
        "starting_time": {"nanoseconds_since_epoch": start},
        "message_count": counts.total(),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic,
                    "type": message_type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": "",
                    "type_description_hash": "",
                },
                "message_count": count,
            }
            for (topic, message_type), count in sorted(counts.items())
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.path.name for file in files],
        "files": [
            {
                "path": file.path.name,
                "starting_time": {"nanoseconds_since_epoch": file.start},
                "duration": {"nanoseconds": file.end - file.start},
                "message_count": file.count,
            }
            for file in files
        ],
        "custom_data": None,
        "ros_distro": "",
    }
    save_yaml(folder / METADATA, {"rosbag2_bagfile_information": content})


def _list_files(folder: Path) -> list[Path]:
    """The files of all runs in their order, those without a name included."""
    found = [(int(match[1]), file) for file in folder.iterdir() if (match := _NAME.fullmatch(file.name))]
    return [file for _, file in sorted(found)]


def _sync_folder(folder: Path) -> None:
    """Has the disk store names of files, where the system can."""
    if hasattr(os, "O_DIRECTORY"):
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
