"""Limits of YAML files: hostile ones end in one line, without the memory and time that they ask for."""

import time
import tracemalloc
import warnings
from pathlib import Path

import pytest

from calgraph.config.rig_config import load_rig
from calgraph.errors import InputError
from calgraph.io.yaml_limits import MAX_DEPTH, MAX_NUMBER_LENGTH, MAX_RIG_VALUES
from calgraph.io.yaml_reading import parse_yaml, read_documents, read_yaml, validate_content

_LEVELS = "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 9))
ALIASES = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + _LEVELS
MERGES = "a0: &a0 {k: 1}\n" + _LEVELS.replace("[", "{<<: [").replace("]", "]}")
HOSTILE = {
    "aliases": (ALIASES, "line 5: has more than 50000 values, where aliases count"),
    "aliases in a key that is checked": (ALIASES.replace("a8:", "target:"), "has more than 50000 values"),
    "merged aliases": (MERGES, "has more than 50000 values"),
    "a cycle": ("root: &a [*a]\n", "line 1: &a contains itself; write its values out"),
    "2000 lists": ("root: " + "[" * 2000 + "]" * 2000, "line 1: nests more than 50 levels deep"),
    "100000 lists that stay open": ("root: " + "[" * 100_000, "nests more than 50 levels deep"),
    "2000 mappings": ("root: " + "{a: " * 2000 + "1" + "}" * 2000, "nests more than 50 levels deep"),
    "a number of 5000 digits": (
        "root: a\nsize: " + "9" * 5000,
        "line 2: a number has 5000 characters, 100 are allowed",
    ),
    "a list of 4 MB": ("root: [" + "a," * 2_000_000 + "a]", "has more than 50000 values"),
    "a date that does not exist": ("root: 2001-99-99", "is not valid YAML .month must be in 1..12"),
    "a tagged number of 5000 digits": ("root: !!int '" + "9" * 5000 + "'", "is not valid YAML .Exceeds the limit"),
    "a text tagged as a number": ("root: !!int abc", "is not valid YAML .invalid literal"),
    "a text tagged as a flag": ("root: !!bool maybe", "is not valid YAML"),
    "a character that does not exist": (r'root: "\UFFFFFFFF"', "is not valid YAML"),
    "a list as key": ("? [a, {b: c}]\n: d\n", "is not valid YAML .unhashable"),
}


_LONG = 10_000
"""Characters. Coverage slows the parser, which is not ours, to a third; shorter texts reach the same lines."""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        pytest.param(*case, id=name, marks=[pytest.mark.slow] if len(case[0]) > _LONG else [])
        for name, case in HOSTILE.items()
    ],
)
def test_hostile_files_end_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(text, encoding="utf-8")
    tracemalloc.start()
    began = time.process_time()
    with pytest.raises(InputError, match=message) as error:
        load_rig(path)
    # Without limits the slowest took over a minute; tracemalloc and coverage slow all of them tenfold.
    assert time.process_time() - began < 40
    assert tracemalloc.get_traced_memory()[1] < 100e6
    tracemalloc.stop()
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 400


@pytest.mark.parametrize("read", [read_yaml, read_documents])
def test_both_readers_have_limits(tmp_path: Path, read: object) -> None:
    path = tmp_path / "calibration.yaml"
    path.write_text(ALIASES, encoding="utf-8")
    with pytest.raises(InputError, match="has more than 1000000 values"):
        read(path)  # type: ignore[operator]


@pytest.mark.slow  # the parser reads 100,000 values
def test_limits_are_where_they_are_stated() -> None:
    path = Path("a.yaml")
    parse_yaml("[" * MAX_DEPTH + "]" * MAX_DEPTH, path)
    parse_yaml("9" * MAX_NUMBER_LENGTH, path)
    parse_yaml("'" + "9" * 5000 + "'", path)
    parse_yaml(f"[{'a, ' * (MAX_RIG_VALUES - 1)}]", path, MAX_RIG_VALUES)
    with pytest.raises(InputError, match="has more than"):
        parse_yaml(f"[{'a, ' * MAX_RIG_VALUES}]", path, MAX_RIG_VALUES)


def test_aliases_of_people_remain(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("a: &n {range: 0.02}\nb: *n\nc: {<<: *n, angle: 1}\n", encoding="utf-8")
    assert read_yaml(path) == {"a": {"range": 0.02}, "b": {"range": 0.02}, "c": {"range": 0.02, "angle": 1}}


def test_a_file_without_end_is_refused() -> None:
    with pytest.raises(InputError, match="/dev/zero: is larger than 64 MB"):
        read_yaml(Path("/dev/zero"))


def test_the_list_of_errors_has_an_end(tmp_path: Path) -> None:
    from calgraph.config import Rig

    with pytest.raises(InputError) as error:
        validate_content(Rig, {f"k{i}": 1 for i in range(1000)}, tmp_path)
    lines = str(error.value).splitlines()
    assert len(lines) == 51
    assert lines[-1].endswith("has 953 further errors")


@pytest.mark.parametrize("read", [read_yaml, read_documents])
def test_an_anchor_may_be_used_again_without_a_warning(tmp_path: Path, read: object) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("a: &n 1\nb: &n 2\nc: *n\n", encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read(path) in ({"a": 1, "b": 2, "c": 2}, [{"a": 1, "b": 2, "c": 2}])  # type: ignore[operator]
