"""Limits of message definitions in recordings, and of messages.

rosbags unrolls arrays into code, makes an object of each part of a message, and takes any number of empty parts.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from rosbags.interfaces import Msgdef, Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

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
