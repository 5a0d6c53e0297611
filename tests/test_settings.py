"""Settings are what a user sets: few, documented, read, and accepted from files of earlier versions."""

import ast
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

import calgraph
from calgraph.cli.setting_options import override_settings, set_nested
from calgraph.config import Rig, load_rig
from calgraph.config.settings import Settings
from calgraph.errors import InputError
from calgraph.io.field_docs import describe_field

SOURCE = Path(calgraph.__file__).parent
FORMER: dict[str, Any] = json.loads((SOURCE / "config" / "former_settings.json").read_text(encoding="utf-8"))
Trees = Mapping[Path, ast.Module]


@pytest.fixture(scope="module")
def trees() -> Trees:
    """The syntax of each module: millions of objects, which no other test shall keep in memory."""
    return {path: ast.parse(path.read_text()) for path in sorted(SOURCE.rglob("*.py"))}


def leaves(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Each setting with its description."""
    for name, field in model.model_fields.items():
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            yield from leaves(inner, f"{prefix}{name}.")
        else:
            yield prefix + name, describe_field(model, name)


def values(model: BaseModel, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Each setting with its value."""
    for name in type(model).model_fields:
        value = getattr(model, name)
        if isinstance(value, BaseModel):
            yield from values(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def test_settings_are_few_and_single_values() -> None:
    assert len(list(leaves(Settings))) <= 95
    assert [name for name, value in values(Settings()) if isinstance(value, tuple | list | dict)] == []


def test_settings_state_their_meanings_and_reasons() -> None:
    assert [name for name, description in leaves(Settings) if len(description.split()) < 6] == []


def test_every_setting_is_read_outside_the_configuration(trees: Trees) -> None:
    read = {
        node.attr
        for path, tree in trees.items()
        if "config" not in path.relative_to(SOURCE).parts
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
    } | {name for name, _ in leaves(Settings) if name.startswith("captures.max_messages.")}
    assert [name for name, _ in leaves(Settings) if name.split(".")[-1] not in read] == []


def test_no_function_has_default_settings(trees: Trees) -> None:
    """A default would silently ignore what the user has set; users of these two functions may have no rig."""
    public = {"estimate_pair", "track_scanner"}
    defaults = [
        f"{path.relative_to(SOURCE)}:{node.lineno} {node.name}"
        for path, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and node.name not in public
        for default in [*node.args.defaults, *node.args.kw_defaults]
        if default is not None
        and ast.unparse(default).endswith("Settings()")
        and "Limit" not in ast.unparse(default)
    ]
    assert defaults == []


def load(folder: Path, settings: dict[str, Any]) -> Rig:
    (folder / "rig.yaml").write_text(
        json.dumps({
            "root": "a",
            "target": {"kind": "people"},
            "sensors": {name: {"kind": "lidar2d", "topic": f"/{name}"} for name in "ab"},
            "settings": settings,
        })
    )  # fmt: skip
    return load_rig(folder / "rig.yaml")


def nest(flat: Mapping[str, Any]) -> dict[str, Any]:
    nested: dict[str, Any] = {}
    for key, value in flat.items():
        set_nested(nested, key.split("."), value)
    return nested


def test_a_file_of_an_earlier_version_that_states_all_settings_is_valid(tmp_path: Path) -> None:
    """As rig.resolved.yaml does: those of today, and those that are constants now."""
    stated = {key: value for key, value in values(Settings()) if value is not None}
    rig = load(tmp_path, nest({**stated, "captures.min_hold": 0.7, **FORMER}))
    assert len(FORMER) == 697
    assert dict(values(rig.settings)) == {**dict(values(Settings())), "captures.min_hold": 0.7}


def test_no_former_setting_has_the_key_of_one_of_today() -> None:
    assert FORMER.keys() & dict(values(Settings())).keys() == set()


def test_another_value_of_a_former_setting_is_an_error_that_names_what_replaces_it(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        load(tmp_path, {"estimation": {"rig": {"huber_threshold": 3.5}}})
    assert str(caught.value).endswith(
        "settings.estimation.rig.huber_threshold: is no setting any more and is always 2.5, got 3.5; "
        "noise and uncertainty of the sensors state what is known about them"
    )


def test_a_former_setting_on_the_command_line_is_an_error(tmp_path: Path) -> None:
    rig = load(tmp_path, {})
    assert override_settings(rig, ["graph.min_trees=8"]).settings == rig.settings
    with pytest.raises(InputError, match=r"graph.min_trees: is no setting any more and is always 8, got 7; "):
        override_settings(rig, ["graph.min_trees=7"])


def test_an_unknown_key_beside_former_ones_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"unknown key settings.captures.min_holds.*min_hold"):
        load(tmp_path, {"captures": {"min_holds": 1, "motion": {"min_gray_change": 12.0}}})


@pytest.mark.parametrize("value", [0.0, -0.5])
def test_a_scanner_stands_still_for_some_time(value: float, tmp_path: Path) -> None:
    key = "tracking.stationarity.min_duration"
    assert dict(values(load(tmp_path, nest({key: 0.1})).settings))[key] == 0.1
    with pytest.raises(InputError, match=r"settings\.tracking\.stationarity\.min_duration.*greater than 0"):
        load(tmp_path, nest({key: value}))


DRAWING = {"cli", "fleet", "live", "printing", "report", "simulation", "viewer"}


def numeric_constants(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and name of each constant of a module that is computed from numbers; no names, tables or indices."""
    for node in tree.body:
        if not isinstance(node, ast.Assign | ast.AnnAssign) or isinstance(node.value, ast.Dict):
            continue
        (target,) = node.targets if isinstance(node, ast.Assign) else (node.target,)
        names = [name.id for name in ast.walk(target) if isinstance(name, ast.Name)]
        numbers = [one.value for one in ast.walk(node.value or node) if isinstance(one, ast.Constant)]
        decimals = any(isinstance(number, float) or (type(number) is int and number > 9) for number in numbers)
        scalar = isinstance(node.value, ast.Constant | ast.Tuple) and any(
            type(number) is int for number in numbers
        )
        words = any(isinstance(number, str) for number in numbers)
        if all(name.isupper() for name in names) and (decimals or scalar) and not words:
            yield node.lineno, ", ".join(names)


def states_reason(lines: list[str], number: int) -> bool:
    """Whether a comment precedes the group of constants of a line, or a docstring follows it."""
    before = number - 2
    while lines[before] and lines[before][0] in "_ABCDEFGHIJKLMNOPQRSTUVWXYZ":
        before -= 1
    return lines[before].startswith("#") or lines[number].startswith('"""')


def test_a_constant_states_its_reason(trees: Trees) -> None:
    unexplained = [
        f"{path.relative_to(SOURCE)}:{number} {name}"
        for path, tree in trees.items()
        if path.relative_to(SOURCE).parts[0] not in DRAWING
        for number, name in numeric_constants(tree)
        if not states_reason(path.read_text().splitlines(), number)
    ]
    assert unexplained == []
