"""Every setting is documented, is used, and reaches the code that uses it."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel

import calgraph
from calgraph.config.settings import Settings

SOURCE = Path(calgraph.__file__).parent
TREES = {path: ast.parse(path.read_text()) for path in sorted(SOURCE.rglob("*.py"))}


def leaves(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, str | None]]:
    """Each setting with its description."""
    for name, field in model.model_fields.items():
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            yield from leaves(inner, f"{prefix}{name}.")
        else:
            yield prefix + name, field.description


@pytest.mark.parametrize(("name", "description"), list(leaves(Settings)))
def test_a_setting_states_its_meaning_and_reason(name: str, description: str | None) -> None:
    assert description is not None
    assert len(description.split()) >= 6, f"{name}: {description}"


def test_every_setting_is_read_outside_the_configuration() -> None:
    read = {
        node.attr
        for path, tree in TREES.items()
        if "config" not in path.relative_to(SOURCE).parts
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
    }
    assert [name for name, _ in leaves(Settings) if name.split(".")[-1] not in read] == []


def functions_with_settings() -> set[str]:
    """Names of functions and methods, and of classes whose constructor, have a parameter ``settings``.

    Commands are not among them: typer calls them, with what ``--set`` states.
    """
    names = set()
    for path, tree in TREES.items():
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


def test_every_call_hands_settings_on() -> None:
    # A parameter with a default value would silently ignore what the user has set.
    takers = functions_with_settings()
    forgetful = [
        f"{path.relative_to(SOURCE)}:{node.lineno} {name}"
        for path, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and (name := getattr(node.func, "id", getattr(node.func, "attr", ""))) in takers
        and not any("settings" in ast.dump(argument) for argument in [*node.args, *node.keywords])
    ]
    assert forgetful == []
