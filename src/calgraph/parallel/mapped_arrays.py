"""Arrays beyond a limit are mapped from temporary files: the system keeps in memory what it has room for."""

import math
import mmap
import pickle
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar
from weakref import finalize

from calgraph.errors import CalibrationError

Value = TypeVar("Value")

# Of arrays in a file, bytes: as many as vector instructions take.
_ALIGNMENT = 64


@contextmanager
def refuse_full_folder(size: int, remedy: str = "") -> Iterator[None]:
    """Raises CalibrationError where measurements of a size, bytes, cannot be written to a temporary file."""
    try:
        yield
    except OSError as error:
        raise CalibrationError(
            f"{tempfile.gettempdir()}: {size} bytes of measurements cannot be written there "
            f"({error.strerror or error}); state another folder for temporary files in TMPDIR{remedy}"
        ) from error


class ArrayMemory:
    """Memory for the arrays of values; further ones are mapped, cannot be changed, and in files without a name.

    Args:
        max_bytes: of arrays in memory; further ones are in files.
    """

    def __init__(self, max_bytes: float = math.inf) -> None:
        self._left = max_bytes

    def keep(self, value: Value, owner: object) -> Value:
        """The value itself, which counts for as long as the owner exists, or a copy with mapped arrays.

        Args:
            value: of a type that can be pickled, if memory is limited.
            owner: of it.

        Raises:
            CalibrationError: the folder of temporary files has too little space.
        """
        limited, size = self._limit(value)
        finalize(owner, self._take, -size)
        return limited

    def limit(self, value: Value) -> Value:
        """As :meth:`keep`, but the value counts from now on."""
        limited, _ = self._limit(value)
        return limited

    def _limit(self, value: Value) -> tuple[Value, int]:
        """The value or its copy, and the size that it takes of the memory."""
        if math.isinf(self._left):
            return value, 0
        buffers: list[pickle.PickleBuffer] = []
        content = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
        arrays = [buffer.raw() for buffer in buffers]
        size = sum(array.nbytes for array in arrays)
        if size > self._left:
            # Only this process has written the content.
            return pickle.loads(content, buffers=_map_arrays(arrays, size)), 0  # noqa: S301
        self._take(size)
        return value, size

    def _take(self, size: int) -> None:
        self._left -= size


def _map_arrays(arrays: Sequence[memoryview], size: int) -> Iterator[memoryview]:
    """The bytes of each array, mapped from a file; the size is that of all."""
    starts = []
    remedy = ", or raise `estimation.network.max_kept_bytes`"
    with refuse_full_folder(size, remedy), tempfile.TemporaryFile() as file:
        for array in arrays:
            file.write(bytes(-file.tell() % _ALIGNMENT))
            starts.append(file.tell())
            file.write(array)
        file.flush()
        mapped = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    return (mapped[start : start + array.nbytes] for start, array in zip(starts, arrays, strict=True))
