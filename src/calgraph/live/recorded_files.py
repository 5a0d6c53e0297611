"""The files of a recording that is made in several runs: a rosbag2 folder, as the tools of ROS 2 read it."""

import os
import re
from contextlib import suppress
from pathlib import Path

from calgraph.config.settings import LimitSettings
from calgraph.recording.bag_metadata import RecordedFile
from calgraph.recording.chunk_limits import open_reader
from calgraph.recording.unfinished_mcap import finish_mcap

_PART = ".part"
_NAME = re.compile(rf"recording_(\d+)\.mcap({re.escape(_PART)})?")


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
