"""Writes the tables of the page on settings, from the settings classes: `python docs/settings_tables.py`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import annotated_types as limits
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from calgraph.config.settings import Settings
from calgraph.io.field_docs import describe_field

_SIGNS = {limits.Gt: ">", limits.Ge: "≥", limits.Lt: "<", limits.Le: "≤"}


PAGE = Path(__file__).parent / "settings.md"
_MARK = "<!-- The rest is written by docs/settings_tables.py. -->"


def settings_page(text: str) -> str:
    """The text of the page with the tables of today."""
    return f"{text.partition(_MARK)[0]}{_MARK}\n\n{settings_tables()}\n"


def settings_tables(model: type[BaseModel] = Settings, key: str = "") -> str:
    """A heading for each class with settings, and a row for each setting, as Markdown."""
    return "\n\n".join(_sections(model, key))


def _sections(model: type[BaseModel], key: str) -> Iterator[str]:
    groups = {name: field.annotation for name, field in model.model_fields.items() if _is_model(field.annotation)}
    rows = [_row(model, name, field) for name, field in model.model_fields.items() if name not in groups]
    summary = " ".join((model.__doc__ or "").split())
    if rows:
        table = "\n".join(["| key | default | limits | meaning |", "| --- | --- | --- | --- |", *rows])
        yield f"## {key}\n\n{summary}\n\n{table}"
    for name, group in groups.items():
        assert group is not None
        yield from _sections(group, f"{key}.{name}".lstrip("."))


def _is_model(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _row(model: type[BaseModel], name: str, field: FieldInfo) -> str:
    # The base class of limits comes with their values in fields named like the sign: gt, ge, lt, le.
    bounds = [
        f"{sign} {getattr(bound, kind.__name__.lower()):g}"
        for bound in field.metadata
        for kind, sign in _SIGNS.items()
        if isinstance(bound, kind)
    ]
    meaning = " ".join(describe_field(model, name).split()).replace("``", "`").replace("|", "\\|")
    return f"| `{name}` | {_format(field.default)} | {', '.join(bounds)} | {meaning} |"


def _format(value: Any) -> str:
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_format, value))}]"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    PAGE.write_text(settings_page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
