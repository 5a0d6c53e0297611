"""A folder of computed results by key, limited in size: the least recently used ones are removed first.

Runs may share it: entries are written in one step, and one that is missing or damaged is computed again.
"""

import os
import re
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import ZIP_STORED

from numpy.typing import NDArray

from calgraph.errors import InputError
from calgraph.io.archive import read_archive, write_archive

_STRUCTURE = "entry.json"
_ENTRY = re.compile(r"[0-9a-f]{64}\.npz")
# Files that writers leave behind when they are killed: those of entries that are never written again stay.
_UNFINISHED = re.compile(r"\.[0-9a-f]{64}\.npz\..*\.tmp")
# Longer than any entry takes to be written, s.
_MAX_WRITING_TIME = 3600.0
MAX_BYTES = 2 * 10**9
"""Default of the maximum size of a cache, bytes: detections and previews of hundreds of recordings of rigs, which
have 5 to 20 MB each, or the tracks of tens of networks."""


@dataclass(frozen=True)
class CacheFolder:
    """Results by key, in a folder that is made when the first one is written."""

    path: Path
    max_bytes: int = MAX_BYTES
    """Maximum size of all entries."""

    def read(self, key: str, format: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]] | None:
        """The JSON object and arrays of an entry; None if there is none, or if it is damaged.

        Args:
            key: 64 hexadecimal digits.
            format: of the entry.
        """
        file = self._file(key)
        if not file.is_file():
            return None
        try:
            content, arrays = read_archive(file, _STRUCTURE, format, self.max_bytes)
        except InputError:
            content, arrays = {}, {}
        if content.get("key") != key:
            self.remove(key)
            return None
        # The time of the last use is that of modification: many file systems do not keep that of reading.
        with suppress(OSError):
            os.utime(file)
        return content, arrays

    def write(self, key: str, format: str, content: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
        """Writes an entry, and removes those that are too much.

        Raises:
            InputError: the folder cannot be written to.
        """
        try:
            self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written ({error.strerror or error})") from error
        # Most of it are JPEGs and measured values, which hardly get smaller.
        write_archive(
            self._file(key), _STRUCTURE, {**content, "format": format, "key": key}, arrays, compression=ZIP_STORED
        )
        self._limit_size()

    def remove(self, key: str) -> None:
        """Removes an entry, if there is one and the folder can be written to."""
        _remove(self._file(key))

    def clear(self) -> None:
        """Removes all entries; other files in the folder stay."""
        for file, _ in self._list():
            _remove(file)

    def measure(self) -> tuple[int, int]:
        """Number of entries, and their bytes."""
        entries = [status for file, status in self._list() if _ENTRY.fullmatch(file.name)]
        return len(entries), sum(status.st_size for status in entries)

    def _file(self, key: str) -> Path:
        return self.path / f"{key}.npz"

    def _list(self) -> list[tuple[Path, os.stat_result]]:
        """Entries and unfinished files."""
        found = []
        with suppress(OSError):
            for file in self.path.iterdir():
                if _ENTRY.fullmatch(file.name) or _UNFINISHED.fullmatch(file.name):
                    with suppress(OSError):  # another run may have removed it
                        found.append((file, file.stat()))
        return found

    def _limit_size(self) -> None:
        remaining = 0
        for file, status in sorted(self._list(), key=lambda entry: entry[1].st_mtime_ns, reverse=True):
            if not _ENTRY.fullmatch(file.name):
                if time.time() - status.st_mtime > _MAX_WRITING_TIME:
                    _remove(file)
                continue
            remaining += status.st_size
            if remaining > self.max_bytes:
                _remove(file)


def default_cache_path() -> Path:
    """The folder that the platform provides for caches of this user.

    Sources: XDG Base Directory Specification; File System Programming Guide (macOS); Known Folders (Windows).
    """
    if sys.platform == "win32":
        local = os.environ.get("LOCALAPPDATA")
        return (Path(local) if local else Path.home() / "AppData" / "Local") / "calgraph" / "Cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "calgraph"
    stated = Path(os.environ.get("XDG_CACHE_HOME", ""))
    # The specification has relative paths ignored.
    return (stated if stated.is_absolute() else Path.home() / ".cache") / "calgraph"


def _remove(file: Path) -> None:
    with suppress(OSError):
        file.unlink()
