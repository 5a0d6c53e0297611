"""Samples of the content of messages, by which identical ones are recognized without decoding them."""

import hashlib
import mmap
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

# 2 kB of a message: enough to distinguish any two measurements, and read in microseconds.
_SAMPLES = 32
_SAMPLE_BYTES = 64


def hash_content(data: bytes | mmap.mmap | NDArray[np.uint8], start: int = 0) -> int:
    """A hash of samples spread over the bytes from ``start`` on, 64 bits with sign; equal for equal bytes."""
    # A damaged message may state a longer frame_id than it has bytes.
    size = max(len(data) - start, 0)
    step = max(size // _SAMPLES, _SAMPLE_BYTES)
    samples = (bytes(data[i : i + _SAMPLE_BYTES]) for i in range(start, len(data), step))
    # Unlike Python's own hash, it is the same in all processes.
    digest = hashlib.blake2b(b"".join((size.to_bytes(8), *samples)), digest_size=8).digest()
    return int.from_bytes(digest, signed=True)


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
