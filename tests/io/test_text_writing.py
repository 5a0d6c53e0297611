"""YAML as readers of both versions of it understand it."""

import math
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from calgraph.io.text_writing import format_yaml
from calgraph.io.yaml_reading import parse_yaml

TEXTS = (
    "", " ", "a b", "a: b", "a:b", "a:", ":a", "#a", "a #b", "a#b", "- a", "-a", "-", "?a", "? a", "it's", '"a"',
    "'a'", "a\nb", "a\tb", "\x07", "\x85", "σ², °", "😀", "[a]", "a]", "{b}", "a, b", "%a", "@a", "`a", "!a", "&a",
    "*a", "|", "> a", "a\\b", " a", "a ", "=", "<<", "~", "null", "yes", "On", "y", "true", "1", "1_000", "1e5",
    "0o7", "0x1f", ".5", ".inf", "12:30:45", "2026-11-29", "2026-11-29T10:00:00+00:00", "---", "--- a", "...",
    "http://a:80/b",
)  # fmt: skip


@pytest.mark.parametrize("version", [(1, 1), (1, 2)])
def test_texts_and_numbers_come_back(version: tuple[int, int]) -> None:
    numbers = [0.1, 1e-6, -1e22, 3, math.inf, True, None]
    content = {
        **{text: text for text in TEXTS},
        "flow": dict.fromkeys(TEXTS, 0),
        "lists": [
            list(TEXTS),
            [],
            {},
            [numbers, [[1.5, 2.5]], {"a": 1, "b": [list(TEXTS)]}],
            {"c": {}, "d": [[]]},
        ],
    }
    yaml = YAML(typ="safe", pure=True)
    yaml.version = version
    assert yaml.load(format_yaml(content)) == content


def test_innermost_lists_and_mappings_are_on_one_line_of_bounded_length() -> None:
    text = format_yaml({"a": [[1, 2], {"b": "c"}], "long": list(range(100))}, "first\nsecond")
    assert text.startswith("# first\n# second\na:\n- [1, 2]\n- {b: c}\nlong: [0, 1, 2,")
    assert max(map(len, text.splitlines())) < 206
    assert parse_yaml(text, Path("a.yaml"))["long"] == list(range(100))
