"""Every setting is documented, is used, and reaches the code that uses it."""

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
from pydantic import BaseModel

import calgraph
from calgraph.config.settings import Settings
from calgraph.io.field_docs import describe_field

SOURCE = Path(calgraph.__file__).parent
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


@pytest.mark.parametrize(("name", "description"), list(leaves(Settings)))
def test_a_setting_states_its_meaning_and_reason(name: str, description: str) -> None:
    assert len(description.split()) >= 6, f"{name}: {description}"


def test_every_setting_is_read_outside_the_configuration(trees: Trees) -> None:
    read = {
        node.attr
        for path, tree in trees.items()
        if "config" not in path.relative_to(SOURCE).parts
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
    }
    assert [name for name, _ in leaves(Settings) if name.split(".")[-1] not in read] == []


def functions_with_settings(trees: Trees) -> set[str]:
    """Names of functions and methods, and of classes whose constructor, have a parameter ``settings``.

    Commands are not among them: typer calls them, with what ``--set`` states.
    """
    names = set()
    for path, tree in trees.items():
        if "cli" in path.relative_to(SOURCE).parts:
            continue
        functions = {n: n.name for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name != "__init__"}
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                constructors = [n for n in node.body if isinstance(n, ast.FunctionDef) and n.name == "__init__"]
                functions |= dict.fromkeys(constructors, node.name)
        for function, name in functions.items():
            arguments = [*function.args.args, *function.args.kwonlyargs]
            if any(argument.arg == "settings" for argument in arguments):
                names.add(name)
    return names


def test_every_call_hands_settings_on(trees: Trees) -> None:
    # A parameter with a default value would silently ignore what the user has set.
    takers = functions_with_settings(trees)
    forgetful = [
        f"{path.relative_to(SOURCE)}:{node.lineno} {name}"
        for path, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and (name := getattr(node.func, "id", getattr(node.func, "attr", ""))) in takers
        and not any("settings" in ast.dump(argument) for argument in [*node.args, *node.keywords])
    ]
    assert forgetful == []


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


def test_a_constant_that_is_not_a_setting_states_its_reason(trees: Trees) -> None:
    # What influences a result is a setting; what stays is a numerical tolerance, a buffer, or a fact.
    unexplained = [
        f"{path.relative_to(SOURCE)}:{number} {name}"
        for path, tree in trees.items()
        if path.relative_to(SOURCE).parts[0] not in DRAWING
        for number, name in numeric_constants(tree)
        if not states_reason(path.read_text().splitlines(), number)
    ]
    assert unexplained == []
