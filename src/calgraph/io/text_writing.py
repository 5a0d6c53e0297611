"""Plain values as texts: YAML that readers of YAML 1.1 and 1.2 understand identically, JSON, and CSV."""

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml.resolver import implicit_resolvers

from calgraph.io.atomic import write_text

# Lists and mappings of single values go on after this many characters on the next line.
_WIDTH = 200
# Texts that readers of either version of YAML take for another type: numbers, true, yes, null, dates.
_OTHER_TYPES = [pattern for _, _, pattern, _ in implicit_resolvers]
# Other texts that need no quotes: no indicator or mark of a document at the start, no comment, no end of a key.
# Within braces and brackets, theirs and commas are indicators as well.
_PLAIN = re.compile(r"(?!---|\.\.\.|[-?:](\s|$))[^\s#&*!|>'\"%@`,\[\]{}=]((?!:\s|\s#|:$).)*(?<!\s)")
_FLOW_INDICATORS = re.compile(r"[,?\[\]{}]|:(?=[,\[\]{}])|^[-:]")


def format_yaml(content: Mapping[str, Any], comment: str = "") -> str:
    """Plain values as YAML, innermost lists and mappings on one line, below a comment.

    ruamel.yaml, which reads YAML here, takes 40 times as long.
    """
    lines = [*(f"# {line}" for line in comment.splitlines()), *_list_lines(content, "")]
    return "".join(f"{line}\n" for line in lines)


def _list_lines(value: Mapping[Any, Any] | Sequence[Any], indent: str) -> Iterator[str]:
    """The lines of a list or mapping that is not empty, each after an indentation."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            head = f"{indent}{_format_scalar(key)}:"
            if _is_on_one_line(part):
                yield from _wrap(f"{head} ", part, f"{indent}  ")
            else:
                yield head
                yield from _list_lines(part, f"{indent}  " if isinstance(part, Mapping) else indent)
    else:
        for part in value:
            if _is_on_one_line(part):
                yield from _wrap(f"{indent}- ", part, f"{indent}  ")
            else:
                first, *others = _list_lines(part, f"{indent}  ")
                yield from (f"{indent}- {first.removeprefix(f'{indent}  ')}", *others)


def _is_collection(value: Any) -> bool:
    return isinstance(value, Mapping | list | tuple)


def _is_on_one_line(value: Any) -> bool:
    parts = value.values() if isinstance(value, Mapping) else value
    return not _is_collection(value) or not any(map(_is_collection, parts))


def _wrap(line: str, value: Any, indent: str) -> Iterator[str]:
    """A value without inner collections after the start of a line; further lines begin with an indentation."""
    if not _is_collection(value):
        yield line + _format_scalar(value)
        return
    if isinstance(value, Mapping):
        begin, end = "{}"
        parts = [f"{_format_scalar(key, True)}: {_format_scalar(part, True)}" for key, part in value.items()]
    else:
        begin, end = "[]"
        parts = [_format_scalar(part, True) for part in value]
    line += begin
    for n, part in enumerate(parts):
        if n:
            line += ","
            if len(line) > _WIDTH:
                yield line
                line = indent
            else:
                line += " "
        line += part
    yield line + end


def _format_scalar(value: Any, in_flow: bool = False) -> str:
    if value is None:
        return "null"  # in full: lists with empty elements are hard to read
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return format_yaml_number(float(value))
    text = str(value)
    if not text.isprintable():
        return '"' + text.encode("unicode_escape").decode().replace('"', '\\"') + '"'
    is_plain = _PLAIN.fullmatch(text) and not (in_flow and _FLOW_INDICATORS.search(text))
    if is_plain and not any(pattern.match(text) for pattern in _OTHER_TYPES):
        return text
    return json.dumps(text, ensure_ascii=False) if "'" in text else f"'{text}'"


def format_yaml_number(value: float) -> str:
    """A number as YAML has it, to the last bit.

    0.000001 becomes 1.0e-06: readers of YAML 1.1 (ROS) take Python's 1e-06 for a text.
    """
    text = {math.inf: ".inf", -math.inf: "-.inf"}.get(value, ".nan" if math.isnan(value) else repr(value))
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def save_yaml(path: Path, content: Mapping[str, Any], comment: str = "") -> None:
    """Writes plain values as YAML in one step.

    Raises:
        InputError: ``path`` cannot be written.
    """
    write_text(path, format_yaml(content, comment))


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
