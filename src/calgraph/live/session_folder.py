"""The folder of a live session: its recording, rig.yaml and result, and what a resumed session needs to know."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from pydantic import Field

from calgraph.config import Rig, load_rig
from calgraph.errors import InputError
from calgraph.io.strict_model import StrictModel
from calgraph.io.text_writing import save_yaml
from calgraph.io.yaml_reading import read_yaml, validate_content
from calgraph.live.live_rig import TRIGGER_TOPIC
from calgraph.live.recorded_files import finish_files, read_files
from calgraph.recording import open_recording
from calgraph.recording.bags import BagRecording

_LOCK = "session.lock"
_NOTES = "session.yaml"
_RIG = "rig.yaml"
_RECORDING = "recording"
# Arrivals of triggers are those of the messages before as floating-point numbers, which differ by less, ns.
_TRIGGER_ERROR = 1000


class _Notes(StrictModel):
    """session.yaml."""

    source: str = Field(min_length=1)
    """Of the messages, as the user gave it."""
    rig: str
    """Path of the user's rig.yaml."""


class SessionFolder:
    """A session's folder; no other process can use it until it is closed or this process ends.

    Made by :func:`create_session` and :func:`resume_session`.

    Attributes:
        path: the folder.
        recording: folder of the recording; the recorder makes it.
        rig_file: rig.yaml of the session.
        result: folder of the result; calibration makes it.
        source: of the messages, as the user gave it first.
    """

    def __init__(self, path: Path, notes: _Notes, lock: BinaryIO) -> None:
        self.path, self.source = path, notes.source
        self._notes, self._lock = notes, lock
        self.recording = path / _RECORDING
        self.rig_file = path / _RIG
        self.result = path / "result"

    def last_arrival(self) -> int:
        """Arrival of the last recorded message, ns; -1 if there is none.

        Raises:
            Exception: anything that rosbags raises for damaged files.
        """
        if not self.recording.is_dir():
            return -1
        files = read_files(self.recording, load_rig(self.rig_file).settings.limits)
        return max((file.end for file in files), default=-1)

    def find_last(self) -> tuple[int, frozenset[str]]:
        """Arrival of the last recorded message of the source, ns, and the topics that have one of this arrival.

        Sources have messages of the same arrival, of which some may not have been written.
        """
        end = self.last_arrival()
        if end < 0:
            return end, frozenset()
        with open_recording(self.recording, load_rig(self.rig_file).settings.limits) as recording:
            assert isinstance(recording, BagRecording)
            topics = [topic.name for topic in recording.topics if topic.name != TRIGGER_TOPIC]
            found = [(raw.arrival, raw.topic) for raw in recording.raw_messages(topics, end - _TRIGGER_ERROR)]
        last = max((arrival for arrival, _ in found), default=end)
        return last, frozenset(topic for arrival, topic in found if arrival == last)

    def exclude(self, window: tuple[float, float]) -> None:
        """Adds a window to ``capture.exclude`` of rig.yaml.

        Args:
            window: start and end, s from the start of the recording.

        Raises:
            InputError: the file cannot be written.
        """
        rig = load_rig(self.rig_file)
        capture = rig.capture.model_copy(update={"exclude": (*rig.capture.exclude, window)})
        self._save_rig(rig.model_copy(update={"capture": capture}))

    def close(self) -> None:
        """Lets other processes use the folder."""
        self._lock.close()

    def _save_rig(self, rig: Rig) -> None:
        comment = f"{self._notes.rig}, for a live session of {self.source}"
        save_yaml(self.rig_file, rig.model_dump(mode="json", exclude_unset=True), comment)


def create_session(path: Path, rig_file: Path, rig: Rig, source: str) -> SessionFolder:
    """Makes the folder of a new session.

    Args:
        path: the folder, which is missing or empty, or of a session that has recorded nothing.
        rig_file: the user's rig.yaml, which a comment names.
        rig: of the session; see :func:`calgraph.live.live_rig.prepare_live_rig`. Its rig.yaml has the keys that
            were stated, and loads to exactly this rig.
        source: of the messages.

    Raises:
        InputError: the folder has files, or cannot be written to.
    """
    _check_empty(path)
    with _wrap_errors(path):
        path.mkdir(parents=True, exist_ok=True)
    notes = _Notes(source=source, rig=str(rig_file))
    folder = SessionFolder(path, notes, _lock_folder(path))
    try:
        # Another process may have been faster.
        _check_empty(path)
        folder._save_rig(rig)
        # It is written last: with it the session is complete.
        save_yaml(path / _NOTES, notes.model_dump())
    except BaseException:
        folder.close()
        raise
    return folder


def resume_session(path: Path) -> SessionFolder:
    """Opens the folder of a session that was interrupted; files of its recording that lack an end get one.

    Raises:
        InputError: it is not the folder of a session, is in use, or cannot be written to.
    """
    if not (path / _NOTES).is_file():
        raise InputError(f"{path}: is not the folder of a live session: it has no {_NOTES}")
    notes = validate_content(_Notes, read_yaml(path / _NOTES), path / _NOTES)
    folder = SessionFolder(path, notes, _lock_folder(path))
    try:
        rig = load_rig(folder.rig_file)
        if folder.recording.is_dir():
            with _wrap_errors(folder.recording):
                finish_files(folder.recording, rig.settings.limits)
    except BaseException:
        folder.close()
        raise
    return folder


def _check_empty(path: Path) -> None:
    with _wrap_errors(path):
        if path.exists() and not path.is_dir():
            raise InputError(f"{path}: is a file, a folder is to be written there")
        names = {entry.name for entry in path.iterdir()} - {_LOCK} if path.exists() else set()
        has_messages = any((path / _RECORDING).glob("*.mcap"))
    # A session that has recorded nothing is begun again, after a wrong address for example.
    if _NOTES in names and names <= {_NOTES, _RIG, _RECORDING} and not has_messages:
        return
    if _NOTES in names:
        raise InputError(
            f"{path}: is the folder of a live session: continue it with `resume` {path}, or give another"
        )
    if names:
        raise InputError(f"{path}: is not empty: give another folder for the session")


def _lock_folder(path: Path) -> BinaryIO:
    """The open lock file; the system releases it with the process, however it ends.

    Raises:
        InputError: another process has it, or it cannot be written.
    """
    with _wrap_errors(path):
        file = (path / _LOCK).open("ab")
    try:
        # Not flock, whose locks live on in the workers that this process has forked.
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise InputError(f"{path}: is in use by another live session") from error
    return file


@contextmanager
def _wrap_errors(path: Path) -> Iterator[None]:
    """Converts errors of the system."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written to ({error.strerror or error})") from error
