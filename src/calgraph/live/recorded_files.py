"""The files of a recording that is made in several runs: a rosbag2 folder, as the tools of ROS 2 read it."""

import os
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from calgraph.config.settings import LimitSettings
from calgraph.errors import CalgraphError
from calgraph.recording import Recording, open_recording
from calgraph.recording.bag_files import RecordedFile
from calgraph.recording.chunk_limits import open_reader
from calgraph.recording.unfinished_mcap import finish_mcap

_PART = ".part"
_NAME = re.compile(rf"recording_(\d+)\.mcap({re.escape(_PART)})?")


def name_next_file(folder: Path) -> Path:
    """The file of the next run."""
    numbers = [int(match[1]) for file in folder.iterdir() if (match := _NAME.fullmatch(file.name))]
    return folder / f"recording_{max(numbers, default=-1) + 1}.mcap"


def name_part(file: Path) -> Path:
    """Where a file is written until it has a message, so that no file of the recording is without."""
    return file.with_name(file.name + _PART)


def sync_folder(path: Path) -> None:
    """Has the disk store names of files, where the system can."""
    if hasattr(os, "O_DIRECTORY"):
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


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


@contextmanager
def open_growing(path: Path, limits: LimitSettings) -> Iterator[Recording | None]:
    """A recording that may still be written to; None before its first chunk is complete.

    It has no end yet, which needs no warning.
    """
    with ExitStack() as stack:
        recording = None
        with suppress(CalgraphError):
            recording = stack.enter_context(open_recording(path, limits, again=True))
        yield recording


def _list_files(folder: Path) -> list[Path]:
    """The files of all runs in their order, those without a name included."""
    found = [(int(match[1]), file) for file in folder.iterdir() if (match := _NAME.fullmatch(file.name))]
    return [file for _, file in sorted(found)]
