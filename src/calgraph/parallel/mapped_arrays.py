"""Arrays beyond a limit are mapped from temporary files: the system keeps in memory what it has room for."""

import mmap
import pickle
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar
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


class KeptValue(ABC):
    """A value that is kept in memory, or whose arrays are in a file."""

    @abstractmethod
    def load(self) -> Any:
        """The value; mapped arrays cannot be changed."""


class ArrayMemory:
    """Memory for the arrays of values.

    Args:
        max_bytes: of arrays in memory; further ones are in files.
    """

    def __init__(self, max_bytes: int) -> None:
        self._left = max_bytes

    def keep(self, value: Any) -> KeptValue:
        """Keeps a value for as long as the result exists.

        Args:
            value: of a type that can be pickled.

        Raises:
            CalibrationError: the folder of temporary files has too little space.
        """
        split = _SplitValue.split(value)
        if split.size > self._left:
            return split.write()
        kept = _InMemory(value)
        self._left -= split.size
        finalize(kept, self._release, split.size)
        return kept

    def limit(self, value: Value) -> Value:
        """The value itself, which counts from now on, or a copy with mapped arrays; otherwise as :meth:`keep`."""
        split = _SplitValue.split(value)
        if split.size > self._left:
            copy: Value = split.write().load()
            return copy
        self._left -= split.size
        return value

    def _release(self, size: int) -> None:
        self._left += size


@dataclass(frozen=True, eq=False)
class _InMemory(KeptValue):
    """A value in memory."""

    value: Any

    def load(self) -> Any:
        """See :meth:`KeptValue.load`."""
        return self.value


@dataclass(frozen=True, eq=False)
class _InFile(KeptValue):
    """A value whose arrays are in a file without a name, which ends with the last of them."""

    content: bytes
    """Without the arrays."""
    arrays: tuple[memoryview, ...]
    """The bytes of each."""

    def load(self) -> Any:
        """See :meth:`KeptValue.load`."""
        # Only this process has written the content.
        return pickle.loads(self.content, buffers=self.arrays)  # noqa: S301


@dataclass(frozen=True, eq=False)
class _SplitValue:
    """The content of a value without its arrays, and these."""

    content: bytes
    arrays: tuple[memoryview, ...]
    """The bytes of each, in memory."""

    @classmethod
    def split(cls, value: Any) -> "_SplitValue":
        buffers: list[pickle.PickleBuffer] = []
        content = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
        return cls(content, tuple(buffer.raw() for buffer in buffers))

    @property
    def size(self) -> int:
        """Of the arrays, bytes."""
        return sum(array.nbytes for array in self.arrays)

    def write(self) -> _InFile:
        """The value with its arrays in a file."""
        starts = []
        remedy = ", or raise `estimation.network.max_kept_bytes`"
        with refuse_full_folder(self.size, remedy), tempfile.TemporaryFile() as file:
            for array in self.arrays:
                file.write(bytes(-file.tell() % _ALIGNMENT))
                starts.append(file.tell())
                file.write(array)
            file.flush()
            mapped = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
        arrays = zip(starts, self.arrays, strict=True)
        return _InFile(self.content, tuple(mapped[start : start + array.nbytes] for start, array in arrays))
