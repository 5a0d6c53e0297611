"""The page on the API has every public name, of which the site shows the docstring."""

import re
from pathlib import Path

import calgraph

PAGE = (Path(__file__).resolve().parents[1] / "docs/api.md").read_text(encoding="utf-8")


def test_every_public_name_is_in_one_section() -> None:
    blocks = re.findall(r":toctree: generated\n(.*?)```", PAGE, re.DOTALL)
    listed = sorted(name.removeprefix("geometry.") for block in blocks for name in block.split())
    assert listed == sorted(set(calgraph.__all__) - {"__version__"})
