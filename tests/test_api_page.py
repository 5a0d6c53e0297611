"""The page on the API can be read without a build: each public name, with the first paragraph of its docstring."""

import inspect
import re
from operator import attrgetter
from pathlib import Path

import pytest

import calgraph

PAGE = (Path(__file__).resolve().parents[1] / "docs/api.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| `(.+?)` \| (.+) \|$", PAGE, re.MULTILINE)


def test_every_public_name_has_one_row() -> None:
    listed = sorted(name.removeprefix("geometry.") for name, _ in ROWS)
    assert listed == sorted(set(calgraph.__all__) - {"__version__"})


@pytest.mark.parametrize(("name", "meaning"), ROWS)
def test_a_row_has_the_first_paragraph_of_the_docstring(name: str, meaning: str) -> None:
    documented = inspect.cleandoc(attrgetter(name)(calgraph).__doc__ or "").split("\n\n")[0]
    assert meaning == " ".join(documented.split()).replace("``", "`").replace("|", "\\|")


def test_the_built_page_has_the_same_names() -> None:
    block = PAGE.partition(":toctree: generated")[2].partition("```")[0]
    assert block.split() == [name for name, _ in ROWS]
