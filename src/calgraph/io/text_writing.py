"""Plain values as texts: YAML that readers of YAML 1.1 and 1.2 understand identically, JSON, and CSV."""

import csv
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from io import StringIO
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedSeq
from ruamel.yaml.nodes import ScalarNode
from ruamel.yaml.representer import RoundTripRepresenter

from calgraph.io.atomic import write_atomically, write_text


def format_yaml(content: Mapping[str, Any], comment: str = "") -> str:
    """Plain values as YAML, innermost lists and mappings on one line, below a comment."""
    yaml = YAML()
    yaml.Representer = _Representer
    yaml.default_flow_style = None
    yaml.width = 200
    yaml.allow_unicode = True
    stream = StringIO()
    yaml.dump(content, stream)
    return "".join(f"# {line}\n" for line in comment.splitlines()) + stream.getvalue()


def format_yaml_number(value: float) -> str:
    """A number as YAML has it, to the last bit.

    0.000001 becomes 1.0e-06: readers of YAML 1.1 (ROS) take ruamel's 1e-06 for a text.
    """
    text = {math.inf: ".inf", -math.inf: "-.inf"}.get(value, ".nan" if math.isnan(value) else repr(value))
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def save_yaml(path: Path, content: Mapping[str, Any], comment: str = "") -> None:
    """Writes plain values as YAML in one step.

    Raises:
        InputError: ``path`` cannot be written.
    """
    write_text(path, format_yaml(content, comment))


def flow_sequence(values: Iterable[object]) -> CommentedSeq:
    """A list that is always written on one line."""
    sequence = CommentedSeq(values)
    sequence.fa.set_flow_style()
    return sequence


class _Representer(RoundTripRepresenter):
    """Writes numbers as :func:`format_yaml_number` does, and null."""

    def represent_number(self, value: float) -> ScalarNode:
        node: ScalarNode = self.represent_scalar("tag:yaml.org,2002:float", format_yaml_number(value))
        return node

    def represent_nothing(self, _value: None) -> ScalarNode:
        """Null in full: lists with empty elements are hard to read."""
        node: ScalarNode = self.represent_scalar("tag:yaml.org,2002:null", "null")
        return node


_Representer.add_representer(float, _Representer.represent_number)
_Representer.add_representer(type(None), _Representer.represent_nothing)


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Writes a table in one step.

    Raises:
        InputError: ``path`` cannot be written.
    """
    with write_atomically(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows(chain([columns], rows))


_FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r")


def escape_formula(text: str) -> str:
    """A text as a cell: after an apostrophe where a spreadsheet would run it as a formula."""
    return f"'{text}" if text.startswith(_FORMULA_STARTS) else text


def format_json(content: Any, indent: int | None = None) -> str:
    """Mappings, sequences, arrays and scalars as JSON; NaN and infinities, which JSON lacks, become null."""
    return json.dumps(_to_plain(content), ensure_ascii=False, allow_nan=False, indent=indent)


def _to_plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _to_plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _to_plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_to_plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
