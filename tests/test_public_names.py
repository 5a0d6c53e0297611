"""What ``import calgraph`` offers."""

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import calgraph
from calgraph.errors import InputError

SOURCE = ast.parse(Path(calgraph.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
STATED = {
    alias.name: node.module or ""
    for node in ast.walk(SOURCE)
    if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("calgraph.")
    for alias in node.names
}


def test_names_are_what_type_checkers_take_them_for() -> None:
    other = [
        name
        for name in calgraph.__all__
        if getattr(calgraph, name) is not getattr(import_module(STATED[name]), name)
    ]
    assert other == []


def test_type_checkers_see_no_other_names() -> None:
    assert set(STATED) == set(calgraph.__all__)


def test_other_names_are_attribute_errors() -> None:
    unknown = "calibrate_ring"
    with pytest.raises(AttributeError, match="has no attribute 'calibrate_ring'"):
        getattr(calgraph, unknown)


def test_names_are_listed_for_completion() -> None:
    assert dir(calgraph) == list(calgraph.__all__)


def test_import_loads_no_room() -> None:
    code = "import sys, calgraph; print([m for m in sys.modules if m.startswith('calgraph.') or m == 'numpy'])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize("name", ["load_calibration", "load_problem", "load_rig", "open_recording"])
def test_paths_may_be_strings(name: str, tmp_path: Path) -> None:
    missing = str(tmp_path / "missing")
    with pytest.raises(InputError, match=f"^{missing}"):
        getattr(calgraph, name)(missing)
