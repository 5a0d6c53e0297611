"""What was computed from recordings, kept by the content of the recording, the program, and the arguments."""

import json
import logging
import platform
from collections.abc import Mapping, Sequence
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from calgraph.errors import InputError
from calgraph.io.cache_folder import MAX_BYTES, CacheFolder
from calgraph.io.records import decode_records, encode_records
from calgraph.recording.content_hash import FileState, hash_files, hash_text, read_states
from calgraph.recording.recording import Recording
from calgraph.recording.takes import ShiftedRecording

_log = logging.getLogger(__name__)

_FORMAT = "calgraph-cache/2"
LATER_ROOMS = (
    "cli", "report", "viewer", "printing", "simulation", "verdict", "graph",
    "rig/pairs", "rig/bundle", "rig/checks", "network/pairs", "network/graph", "network/joint", "network/checks",
)  # fmt: skip
"""Packages that read no recording: results that are kept stay valid when these change."""
_LIBRARIES = ("calgraph", "numpy", "scipy", "opencv-python-headless", "pupil-apriltags", "rosbags", "av")


class RecordingCache:
    """Results of passes over recordings.

    A result is found again if the recording has the same content, wherever it is, and if the arguments, calgraph
    and the libraries that it was computed with are the same. What cannot be kept is computed each time: in a
    folder that cannot be written to, and of recordings in memory.

    Args:
        path: of the folder; without it nothing is kept.
        max_bytes: maximum size of the folder; the least recently used results are removed first.
    """

    def __init__(self, path: Path | str | None, max_bytes: int = MAX_BYTES) -> None:
        self._folder = CacheFolder(Path(path), max_bytes) if path else None
        self._writable = True
        self._contents: dict[tuple[Path, ...], tuple[str, tuple[FileState, ...]]] = {}
        self.reused: set[str] = set()
        """Names of the sensors whose detections or tracks were found."""

    def read(self, recording: Recording, kind: str, inputs: Mapping[str, Any], types: Sequence[type] = ()) -> Any:
        """A result; None if it is not kept, or damaged.

        Args:
            recording: what it was computed from.
            kind: what it is, with the version of its format.
            inputs: everything else that it depends on: plain values, arrays and models.
            types: the classes in it, see :func:`calgraph.io.records.decode_records`.
        """
        key = self._key(recording, kind, inputs)
        found = self._folder.read(key, _FORMAT) if self._folder and key else None
        if self._folder is None or key is None or found is None:
            return None
        content, arrays = found
        try:
            return decode_records(content["result"], arrays, types)
        except (LookupError, RecursionError, TypeError, ValueError):
            self._folder.remove(key)
            return None

    def write(self, recording: Recording, kind: str, inputs: Mapping[str, Any], result: object) -> None:
        """Keeps a result, which is no None; the other arguments are those of :meth:`read`."""
        key = self._key(recording, kind, inputs)
        if self._folder is None or key is None or not self._writable:
            return
        try:
            if read_states(recording.sources) != self._contents[recording.sources][1]:
                return  # it is being written: the result is not of the content that was hashed
            content, arrays = encode_records(result)
            self._folder.write(key, _FORMAT, {"result": content}, arrays)
        except (InputError, OSError) as error:
            self._writable = False
            _log.warning("the cache is not used: %s; set CALGRAPH_CACHE to another folder, or to off", error)

    def _key(self, recording: Recording, kind: str, inputs: Mapping[str, Any]) -> str | None:
        """The key of a result; None if it cannot be kept."""
        if self._folder is None or not recording.sources:
            return None
        if recording.sources not in self._contents:
            try:
                states = read_states(recording.sources)
                self._contents[recording.sources] = hash_files(recording.sources, self._folder), states
            except OSError:
                return None  # an error that reading the recording reports
        content, _ = self._contents[recording.sources]
        offsets = recording.stamp_offsets if isinstance(recording, ShiftedRecording) else {}
        key = [kind, self._program, content, offsets, inputs]
        return hash_text(json.dumps(key, sort_keys=True, default=_to_plain))

    @cached_property
    def _program(self) -> str:
        """The hash of everything that may change a result between two runs with the same arguments."""
        package = Path(__file__).parents[1]
        later = tuple(f"{room}/" for room in LATER_ROOMS)
        files = sorted((file.relative_to(package).as_posix(), file) for file in package.rglob("*.py"))
        sources = [file for name, file in files if not name.startswith(later)]
        system = platform.python_version(), platform.system(), platform.machine()
        versions = [_find_version(library) for library in _LIBRARIES]
        return hash_text(repr([system, versions, [hash_text(file.read_text("utf-8")) for file in sources]]))


def _find_version(library: str) -> str | None:
    """The version of a library; None if it is not installed."""
    try:
        return version(library)
    except PackageNotFoundError:
        return None


def _to_plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    raise TypeError(f"{type(value).__name__} is no input of a result that can be kept")


NO_CACHE = RecordingCache(None)
"""Keeps nothing."""
