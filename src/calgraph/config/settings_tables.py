"""The tables of the page on settings, from the settings classes."""

from collections.abc import Iterator
from typing import Any

import annotated_types as limits
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from calgraph.config.settings import Settings
from calgraph.io.field_docs import describe_field

_SIGNS = {limits.Gt: ">", limits.Ge: "≥", limits.Lt: "<", limits.Le: "≤"}


def settings_tables(model: type[BaseModel] = Settings) -> str:
    """A heading for each stage, and a row for each of its settings, as Markdown."""
    return "\n\n".join(
        "\n".join([f"## {stage}", "", "| key | default | limits | meaning |", "| --- | --- | --- | --- |", *rows])
        for stage, field in model.model_fields.items()
        if (rows := list(_rows(field.annotation, "")))
    )


def _rows(model: Any, key: str) -> Iterator[str]:
    """Rows of the settings of a class and of the classes within it, whose keys begin so."""
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from _rows(field.annotation, f"{key}{name}.")
        else:
            yield _row(model, key, name, field)


def _row(model: type[BaseModel], key: str, name: str, field: FieldInfo) -> str:
    # The base class of limits comes with their values in fields named like the sign: gt, ge, lt, le.
    bounds = [
        f"{sign} {getattr(bound, kind.__name__.lower()):g}"
        for bound in field.metadata
        for kind, sign in _SIGNS.items()
        if isinstance(bound, kind)
    ]
    # What follows a colon is the reason for the default, which is in the code.
    meaning = " ".join(describe_field(model, name).split()).partition(": ")[0].rstrip(".")
    meaning = meaning.replace("``", "`").replace("|", "\\|")
    return f"| `{key}{name}` | {_format(field.default)} | {', '.join(bounds)} | {meaning} |"


def _format(value: Any) -> str:
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_format, value))}]"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
