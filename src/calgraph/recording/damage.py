"""Damaged and hostile recordings: limits of what is read, and errors that state where it was.

rosbags unrolls arrays into code, makes an object of each part of a message, and takes any number of empty parts:
both have limits. Checks of sizes name the setting, and their callers the location.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from rosbags.interfaces import Msgdef, Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from calgraph.config.settings import LimitSettings
from calgraph.errors import CalgraphError, RecordingError
from calgraph.io.git_lfs import POINTER_START, check_git_lfs

MAX_RANGE = 1e5
"""Larger ranges and coordinates count as beams without a return, m: no scanner measures so far. Damaged messages
have coordinates that no grid of cells can number."""
MAX_DEFINITION = 2**18
"""Maximum length of the text of a definition, with those of the types that it contains, characters: the longest of
ROS have 100,000. It is parsed in some seconds."""
MAX_ARRAY = 1000
"""Maximum length of arrays of a fixed length whose elements are messages or texts; those of ROS have up to 100."""
MAX_PARTS = 100_000
"""Maximum number of messages inside a message: each is an object of some 300 bytes. Scans of scanners with several
echoes have one for each of some 2,000 beams."""
MAX_TEXTS_BYTES = 2**24
"""Maximum size of a message with a list of texts, each of which is an object. No sensor sends any."""


@contextmanager
def wrap_errors(where: object, advice: str = "") -> Iterator[None]:
    """Converts exceptions of libraries and decoders into a RecordingError with a location.

    Damaged bytes make the parsers below us raise nearly anything (struct.error, AssertionError, KeyError, zlib
    and database errors), hence the broad except clause; exceptions of calgraph pass unchanged.
    """
    try:
        yield
    except CalgraphError:
        raise
    except Exception as error:
        raise RecordingError(f"{where}: {_explain(error)}{'; ' if advice else ''}{advice}") from error


def check_fetched(path: Path) -> None:
    """Checks that a file is the file itself.

    Raises:
        RecordingError: it is a Git LFS pointer, or cannot be read.
    """
    try:
        with path.open("rb") as file:
            start = file.read(POINTER_START)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror or error})") from error
    check_git_lfs(path, start, RecordingError)


def _explain(error: Exception) -> str:
    """The text of an exception where it is a sentence; parsers of damaged bytes also raise keys and indices."""
    text = " ".join(str(error).split())
    if " " in text and not isinstance(error, LookupError | TypeError | AttributeError | AssertionError):
        return text
    return (
        f"its content is damaged or not of its stated format ({type(error).__name__}{': ' if text else ''}{text})"
    )


def check_unpacked_size(size: int, limits: LimitSettings) -> None:
    """Checks the size of data before or while they are unpacked, bytes.

    Raises:
        ValueError: they are larger than the limit.
    """
    if size > limits.max_unpacked_bytes:
        raise ValueError(
            f"unpacks to more than the limit of {limits.max_unpacked_bytes / 1e6:.0f} MB: it is damaged, or needs "
            "limits.max_unpacked_bytes in the settings"
        )


def check_pixel_count(width: int, height: int, limits: LimitSettings, *, several_scans: bool = False) -> None:
    """Checks the size of an image before it is decoded, pixels.

    Args:
        width: columns.
        height: rows.
        limits: that state how many pixels are allowed.
        several_scans: whether it is a JPEG in several scans. Its decoder keeps all coefficients, 2 bytes for each
            of up to three channels, besides 3 bytes of each pixel: a third of the pixels is allowed.

    Raises:
        ValueError: it is larger than the limit.
    """
    allowed = limits.max_image_pixels // 3 if several_scans else limits.max_image_pixels
    if width * height > allowed:
        form = " in a progressive JPEG" if several_scans else ""
        raise ValueError(
            f"image states {width} x {height} pixels, more than the limit of {allowed}{form}: it is "
            "damaged, or needs limits.max_image_pixels in the settings"
        )


def check_point_count(count: int, limits: LimitSettings) -> None:
    """Checks the number of points of a cloud, or of beams of a scan.

    Raises:
        ValueError: there are more than the limit.
    """
    if count > limits.max_points:
        raise ValueError(
            f"has {count} points, more than the limit of {limits.max_points}: it is damaged, or needs "
            "limits.max_points in the settings"
        )


class LimitedStore(Typestore):
    """The types of one definition; deserializing stops at limits."""

    def __init__(self, release: Stores = Stores.EMPTY) -> None:
        super().__init__()
        defaults = get_typestore(release)
        self.fielddefs.update(defaults.fielddefs)
        self.types.update(defaults.types)
        self._parts = 0
        self._with_texts: dict[str, bool] = {}

    def get_msgdef(self, typename: str) -> Msgdef[object]:
        """The functions that read a type, generated when it is needed first; they count what they read."""
        if typename not in self.cache:
            found = super().get_msgdef(typename)
            self.cache[typename] = replace(
                found,
                deserialize_cdr_le=self._count_calls(found.deserialize_cdr_le),
                deserialize_cdr_be=self._count_calls(found.deserialize_cdr_be),
                deserialize_ros1=self._count_calls(found.deserialize_ros1),
            )
        return self.cache[typename]

    def deserialize_cdr(self, rawdata: bytes | memoryview, typename: str) -> object:
        """The message as an object; raises SerdeError if it does not fit its definition, or exceeds a limit."""
        self._start(rawdata, typename)
        return super().deserialize_cdr(rawdata, typename)

    def deserialize_ros1(self, rawdata: bytes | memoryview, typename: str) -> object:
        """The same of a message of ROS 1."""
        self._start(rawdata, typename)
        return super().deserialize_ros1(rawdata, typename)

    def _start(self, raw: bytes | memoryview, typename: str) -> None:
        self._parts = 0
        if typename not in self._with_texts:
            self._with_texts[typename] = any(
                kind[0] == Nodetype.SEQUENCE and kind[1][0][0] == Nodetype.BASE and kind[1][0][1][0] == "string"
                for kind in _reachable_fields(self, typename)
            )
        if self._with_texts[typename] and len(raw) > MAX_TEXTS_BYTES:
            raise SerdeError(
                f"a message with a list of texts has {len(raw)} bytes, more than the limit of {MAX_TEXTS_BYTES}"
            )

    def _count_calls(self, deserialize: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*arguments: Any) -> Any:
            self._parts += 1
            if self._parts > MAX_PARTS:
                raise SerdeError(f"a message contains more than the limit of {MAX_PARTS} messages: it is damaged")
            return deserialize(*arguments)

        return counted


def check_definition(text: str) -> None:
    """Checks the length of a definition before it is parsed.

    Raises:
        ValueError: it is longer than the limit.
    """
    if len(text) > MAX_DEFINITION:
        raise ValueError(f"has {len(text)} characters, more than the limit of {MAX_DEFINITION}")


def check_arrays(store: Typestore, name: str) -> None:
    """Checks the arrays of a parsed definition before code is made from it.

    Raises:
        ValueError: an array of messages or texts is longer than the limit.
    """
    for kind in _reachable_fields(store, name):
        if kind[0] == Nodetype.ARRAY:
            element, length = kind[1]
            if length > MAX_ARRAY and (element[0] == Nodetype.NAME or element[1][0] == "string"):
                raise ValueError(f"has an array of {length} messages or texts, more than the limit of {MAX_ARRAY}")


def _reachable_fields(store: Typestore, name: str) -> Iterator[Any]:
    """The types of all fields of a message and of the messages that it contains."""
    found, waiting = {name}, [name]
    while waiting:
        _, fields = store.fielddefs.get(waiting.pop(), ((), ()))
        for _, kind in fields:
            yield kind
            inner: Any = kind if kind[0] == Nodetype.NAME else kind[1][0]
            if inner[0] == Nodetype.NAME and inner[1] not in found:
                found.add(inner[1])
                waiting.append(inner[1])
