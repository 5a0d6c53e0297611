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
