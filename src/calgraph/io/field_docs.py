"""The fields of a model, and their docstrings, read from its source when they are shown.

pydantic's ``use_attribute_docstrings`` reads them when a model is imported, which takes a quarter of a
second for all of rig.yaml.
"""

import ast
import inspect
import textwrap
from collections.abc import Iterator
from functools import cache
from itertools import pairwise

from pydantic import BaseModel


def walk_fields(
    model: type[BaseModel], above: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], type[BaseModel]]]:
    """The keys of each value in a model and in the models within it, and the model of the last key, in order."""
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from walk_fields(field.annotation, (*above, name))
        else:
            yield (*above, name), model


def describe_field(model: type, name: str) -> str:
    """The docstring below a field; empty if it has none, or the source is not installed."""
    for owner in model.__mro__:
        if name in vars(owner).get("__annotations__", ()):
            return _read_docstrings(owner).get(name, "")
    return ""


@cache
def _read_docstrings(owner: type) -> dict[str, str]:
    try:
        source = inspect.getsource(owner)
    except OSError:
        return {}
    (definition,) = ast.parse(textwrap.dedent(source)).body
    assert isinstance(definition, ast.ClassDef)
    found = {}
    for field, text in pairwise(definition.body):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            match text:
                case ast.Expr(ast.Constant(str(docstring))):
                    found[field.target.id] = inspect.cleandoc(docstring)
    return found
