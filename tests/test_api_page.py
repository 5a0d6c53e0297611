"""The page on the API can be read without a build: each public name, with the first paragraph of its docstring."""

import inspect
import re
from operator import attrgetter
from pathlib import Path

import calgraph

PAGE = (Path(__file__).resolve().parents[1] / "docs/api.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| `(.+?)` \| (.+) \|$", PAGE, re.MULTILINE)


def test_every_public_name_has_one_row() -> None:
    listed = sorted(name.removeprefix("geometry.") for name, _ in ROWS)
    assert listed == sorted(set(calgraph.__all__) - {"__version__"})


def test_rows_have_the_first_paragraphs_of_the_docstrings() -> None:
    documented = {
        name: " ".join(inspect.cleandoc(attrgetter(name)(calgraph).__doc__ or "").partition("\n\n")[0].split())
        for name, _ in ROWS
    }
    assert dict(ROWS) == {name: text.replace("``", "`").replace("|", "\\|") for name, text in documented.items()}


def test_the_built_page_has_the_same_names() -> None:
    block = PAGE.partition(":toctree: generated")[2].partition("```")[0]
    assert block.split() == [name for name, _ in ROWS]
