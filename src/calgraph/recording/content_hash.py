"""Hashes of what a recording holds: of its files, remembered while these do not change, and of messages."""

import hashlib
import mmap
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import InputError
from calgraph.io.cache_folder import CacheFolder

_FORMAT = "calgraph-content-hash/1"
# The coarsest resolution of file times, that of FAT, s: within it a file may change twice.
_TIME_RESOLUTION = 2.0


@dataclass(frozen=True)
class FileState:
    """What changes when a file does."""

    name: str
    """With the folders in which a recording has it."""
    device: int
    number: int
    """Of its inode."""
    size: int
    """Bytes."""
    modified: int
    changed: int
    """Times of the last change of its content, and of its status, which no program can set back; ns."""


def read_states(paths: Iterable[Path]) -> tuple[FileState, ...]:
    """The states of files, and of all files in folders.

    Raises:
        OSError: one of them cannot be read.
    """
    return tuple(_read_state(name, file) for name, file in _list_files(paths))


def hash_files(paths: Sequence[Path], folder: CacheFolder) -> str:
    """BLAKE2b of the names and contents of files, and of all files in folders.

    Args:
        paths: files and folders. Folders above them do not count: recordings may be moved.
        folder: remembers the hash of files in the same state.

    Raises:
        OSError: one of them cannot be read.
    """
    states = read_states(paths)
    key = hash_text(repr([_FORMAT, *map(astuple, states)]))
    remembered = folder.read(key, _FORMAT)
    if remembered is not None:
        return str(remembered[0]["hash"])
    began = time.time()
    content = hash_text("".join(hash_text(name) + _hash_file(file) for name, file in _list_files(paths)))
    last_change = max((max(state.modified, state.changed) for state in states), default=0) / 1e9
    if began - last_change > _TIME_RESOLUTION and read_states(paths) == states:
        with suppress(InputError):  # it is computed again
            folder.write(key, _FORMAT, {"hash": content}, {})
    return content


def hash_text(text: str) -> str:
    """BLAKE2b of a text, 64 hexadecimal digits."""
    return hashlib.blake2b(text.encode(), digest_size=32).hexdigest()


def _hash_file(file: Path) -> str:
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "blake2b").hexdigest()


def _read_state(name: str, file: Path) -> FileState:
    state = file.stat()
    return FileState(name, state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns)


def _list_files(paths: Iterable[Path]) -> Iterator[tuple[str, Path]]:
    """Names and paths of files, and of all files in folders, links to folders included; in a fixed order."""
    for path in paths:
        yield from _list_below(path.resolve(), path.resolve().name, ())


def _list_below(path: Path, name: str, above: tuple[Path, ...]) -> Iterator[tuple[str, Path]]:
    if not path.is_dir():
        yield name, path
    elif path.resolve() not in above:  # else a link to a folder above it
        for inner in sorted(path.iterdir()):
            yield from _list_below(inner, f"{name}/{inner.name}", (*above, path.resolve()))


# 2 kB of a message: enough to distinguish any two measurements, and read in microseconds.
_SAMPLES = 32
_SAMPLE_BYTES = 64


def hash_content(data: bytes | mmap.mmap | NDArray[np.uint8], start: int = 0) -> int:
    """A hash of samples spread over the bytes from ``start`` on, 64 bits with sign; equal for equal bytes."""
    # A damaged message may state a longer frame_id than it has bytes.
    content = np.frombuffer(data, np.uint8)[start:]
    step = max(len(content) // _SAMPLES, _SAMPLE_BYTES)
    end = len(content) - len(content) % step
    first, last = content[:end].reshape(-1, step)[:, :_SAMPLE_BYTES], content[end : end + _SAMPLE_BYTES]
    # Unlike Python's own hash, it is the same in all processes.
    hashed = hashlib.blake2b(len(content).to_bytes(8) + first.tobytes() + last.tobytes(), digest_size=8)
    return int.from_bytes(hashed.digest(), signed=True)


def hash_array(values: NDArray[Any]) -> int:
    """The same of an array's values."""
    return hash_content(np.ascontiguousarray(values).reshape(-1).view(np.uint8))


def hash_file(path: Path) -> int:
    """The same of a file."""
    with path.open("rb") as file:
        if path.stat().st_size == 0:
            return hash_content(b"")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return hash_content(data)
