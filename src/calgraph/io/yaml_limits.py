"""Limits of YAML files, checked on the parser's events: before any value is made, and before aliases are expanded.

They bound time and memory: an alias repeats what its anchor names, so that 1 kB of nested aliases stands for
gigabytes, and the parser recurses into nested lists.
"""

import re
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.events import (
    AliasEvent,
    CollectionEndEvent,
    CollectionStartEvent,
    DocumentStartEvent,
    Event,
    ScalarEvent,
)
from ruamel.yaml.parser import Parser

from calgraph.errors import InputError

MAX_TEXT_BYTES = 64_000_000
"""Of any text file that is read whole. The largest that calgraph writes, calibration.yaml of 160 scanners, has
20 MB; robots with meshes have URDFs below 1 MB."""
MAX_VALUES = 1_000_000
"""In one YAML file, aliases counted as what they stand for: the joint covariance of 160 scanners. Reading takes
some 30 s and 1 GB then."""
MAX_RIG_VALUES = 50_000
"""In a rig.yaml, which is written by hand: that of 100 sensors with all keys has some 3,000."""
MAX_DEPTH = 50
"""Of nested lists and mappings; files that calgraph reads have up to 8. Python's recursion ends at 1,000."""
MAX_NUMBER_LENGTH = 100
"""Characters of a number: Python's longest form of a float has 25."""

_NUMBER = re.compile(r"[-+]?[0-9][0-9a-fA-FxoX_.:+-]*")


def create_limited_yaml(path: Path, max_values: int = MAX_VALUES) -> YAML:
    """A loader of one text, which checks the limits of a document before its values are made.

    It raises InputError where the text exceeds a limit, or an anchor contains its own alias.
    """
    limits = _Limits(path, max_values)

    class LimitedParser(Parser):
        def get_event(self) -> Any:
            event = super().get_event()
            limits.check(event)
            return event

    class Constructor(SafeConstructor):
        pass

    # The tag that OpenCV's FileStorage gives its matrices: mappings with rows, cols, dt and data.
    Constructor.add_constructor("tag:yaml.org,2002:opencv-matrix", SafeConstructor.construct_yaml_map)
    yaml = YAML(typ="safe", pure=True)
    yaml.Parser = LimitedParser
    yaml.Constructor = Constructor
    return yaml


class _Limits:
    """Counts what the events of a text ask for."""

    def __init__(self, path: Path, max_values: int) -> None:
        self._path, self._max_values, self._count = path, max_values, 0
        self._sizes: dict[str, int] = {}
        self._open: list[tuple[str | None, int]] = []

    def check(self, event: Event) -> None:
        """Counts an event.

        Raises:
            InputError: the text exceeds a limit, or an anchor contains its own alias.
        """
        if isinstance(event, ScalarEvent):
            self._count += 1
            if event.anchor is not None:
                self._sizes[event.anchor] = 1
            self._check_number(event)
        elif isinstance(event, CollectionStartEvent):
            self._open.append((event.anchor, self._count))
            self._count += 1
        elif isinstance(event, CollectionEndEvent):
            anchor, before = self._open.pop()
            if anchor is not None:
                self._sizes[anchor] = self._count - before
        elif isinstance(event, AliasEvent):
            if any(anchor == event.anchor for anchor, _ in self._open):
                raise InputError(f"{self._place(event)}: &{event.anchor} contains itself; write its values out")
            self._count += self._sizes.get(event.anchor, 1)
        elif isinstance(event, DocumentStartEvent):
            self._sizes.clear()
        if len(self._open) > MAX_DEPTH:
            raise InputError(f"{self._place(event)}: nests more than {MAX_DEPTH} levels deep; close brackets")
        if self._count > self._max_values:
            raise InputError(
                f"{self._place(event)}: has more than {self._max_values} values, where aliases count as what they "
                "repeat; give a smaller file"
            )

    def _check_number(self, event: ScalarEvent) -> None:
        is_plain = event.implicit[0]
        if is_plain and len(event.value) > MAX_NUMBER_LENGTH and _NUMBER.fullmatch(event.value):
            raise InputError(
                f"{self._place(event)}: a number has {len(event.value)} characters, "
                f"{MAX_NUMBER_LENGTH} are allowed; round it, or put a text in quotes"
            )

    def _place(self, event: Event) -> str:
        return f"{self._path}, line {event.start_mark.line + 1}"
