"""Limits of YAML files, checked on the parser's events: before any value is made, and before aliases are expanded.

They bound time and memory: an alias repeats what its anchor names, so that 1 kB of nested aliases stands for
gigabytes, and the parser recurses into nested lists.
"""

import re
from pathlib import Path

from ruamel.yaml import YAML
from ruamel.yaml.events import (
    AliasEvent,
    CollectionEndEvent,
    CollectionStartEvent,
    DocumentStartEvent,
    Event,
    ScalarEvent,
)

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


def check_yaml_limits(path: Path, text: str, max_values: int = MAX_VALUES) -> None:
    """Checks the limits of all documents in a text; a text that is not YAML passes up to its error.

    Raises:
        InputError: the text exceeds a limit, or an anchor contains its own alias.
        ruamel.yaml.error.YAMLError: the text is not YAML.
    """
    count = 0
    sizes: dict[str, int] = {}
    open_collections: list[tuple[str | None, int]] = []
    for event in YAML(typ="safe").parse(text):
        if isinstance(event, DocumentStartEvent):
            sizes.clear()
        elif isinstance(event, CollectionStartEvent):
            open_collections.append((event.anchor, count))
            count += 1
        elif isinstance(event, CollectionEndEvent):
            anchor, before = open_collections.pop()
            if anchor is not None:
                sizes[anchor] = count - before
        elif isinstance(event, AliasEvent):
            if any(anchor == event.anchor for anchor, _ in open_collections):
                raise InputError(f"{_place(path, event)}: &{event.anchor} contains itself; write its values out")
            count += sizes.get(event.anchor, 1)
        elif isinstance(event, ScalarEvent):
            count += 1
            if event.anchor is not None:
                sizes[event.anchor] = 1
            _check_number(path, event)
        if len(open_collections) > MAX_DEPTH:
            raise InputError(f"{_place(path, event)}: nests more than {MAX_DEPTH} levels deep; close brackets")
        if count > max_values:
            raise InputError(
                f"{_place(path, event)}: has more than {max_values} values, where aliases count as what they "
                "repeat; give a smaller file"
            )


def _check_number(path: Path, event: ScalarEvent) -> None:
    is_plain = event.implicit[0]
    if is_plain and len(event.value) > MAX_NUMBER_LENGTH and _NUMBER.fullmatch(event.value):
        raise InputError(
            f"{_place(path, event)}: a number has {len(event.value)} characters, "
            f"{MAX_NUMBER_LENGTH} are allowed; round it, or put a text in quotes"
        )


def _place(path: Path, event: Event) -> str:
    return f"{path}, line {event.start_mark.line + 1}"
