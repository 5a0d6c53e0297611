"""The tables of the page on settings, from the settings classes."""

from typing import Any

import annotated_types as limits
from pydantic import BaseModel

from calgraph.config.settings import Settings
from calgraph.io.field_docs import describe_field, walk_fields

_SIGNS = {limits.Gt: ">", limits.Ge: "≥", limits.Lt: "<", limits.Le: "≤"}


def settings_tables() -> str:
    """A heading for each stage, and a row for each of its settings, as Markdown."""
    rows: dict[str, list[str]] = {}
    for (stage, *keys), model in walk_fields(Settings):
        rows.setdefault(stage, []).append(_row(".".join(keys), model, keys[-1]))
    head = ["", "| key | default | limits | meaning |", "| --- | --- | --- | --- |"]
    return "\n\n".join("\n".join([f"## {stage}", *head, *of_stage]) for stage, of_stage in rows.items())


def _row(key: str, model: type[BaseModel], name: str) -> str:
    field = model.model_fields[name]
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
    return f"| `{key}` | {_format(field.default)} | {', '.join(bounds)} | {meaning} |"


def _format(value: Any) -> str:
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_format, value))}]"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
