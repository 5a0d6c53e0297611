"""A settings model as command line options: one for every field, nested ones included."""

import inspect
import json
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

import typer
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from rich.markup import escape

from calgraph.cli.common_options import list_choices
from calgraph.cli.setting_options import parse_value, set_nested
from calgraph.errors import InputError
from calgraph.io.field_docs import describe_field, walk_fields
from calgraph.io.yaml_reading import unwrap_annotation, validate_content

Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True)
class ModelOption:
    """One field of a settings model."""

    path: tuple[str, ...]
    """Its keys, from the outermost model."""
    field: FieldInfo
    description: str
    """The docstring of the field."""
    panel: str
    """The title it stands under in the help."""

    @property
    def option(self) -> str:
        """Its option, such as ``--camera-rate``."""
        return "--" + "-".join(self.path).replace("_", "-")

    @property
    def parameter(self) -> str:
        """The name of its function parameter."""
        return "_".join(self.path)


def list_options(model: type[BaseModel], panels: Mapping[str, str]) -> Iterator[ModelOption]:
    """The options of a settings model, in order.

    Args:
        model: the model; the docstrings of its fields become the help.
        panels: titles by the name of the outermost field from which on they hold.
    """
    panel = ""
    for path, owner in walk_fields(model):
        panel = panels.get(path[0], panel)
        field = owner.model_fields[path[-1]]
        if get_origin(field.annotation) is not Literal or len(get_args(field.annotation)) > 1:
            yield ModelOption(path, field, describe_field(owner, path[-1]), panel)


def add_options(
    command: Callable[..., None], model_options: Mapping[str, ModelOption], defaults: BaseModel
) -> Callable[..., None]:
    """``command`` with an option for each field in the place of its parameter ``**options``.

    An option that is not given does not reach the command.

    Args:
        command: takes its parameters and ``**options``, the values by parameter.
        model_options: by parameter.
        defaults: what the help shows as the defaults.
    """

    def run(**given: Any) -> None:
        command(**{name: value for name, value in given.items() if value is not None or name not in model_options})

    fixed = [p for p in inspect.signature(command).parameters.values() if p.kind is not p.VAR_KEYWORD]
    options = [
        inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=_annotation(option, defaults)
        )
        for name, option in model_options.items()
    ]
    parameters = [*(p.replace(kind=p.KEYWORD_ONLY) for p in fixed), *options]
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    run.__doc__ = command.__doc__
    return run


def apply_options(initial: Model, model_options: Mapping[str, ModelOption], given: Mapping[str, Any]) -> Model:
    """The settings with the options given put over start values.

    Args:
        initial: the start values.
        model_options: by parameter.
        given: values of the options by parameter, numbers and lists still as text.

    Raises:
        InputError: a value is wrong; the message names its option.
    """
    content = initial.model_dump(mode="json", exclude_none=True)
    for parameter, value in given.items():
        set_nested(content, model_options[parameter].path, _parse_value(model_options[parameter], value))
    here = Path("options")
    try:
        return validate_content(type(initial), content, here)
    except InputError as error:
        lines = (line.removeprefix(f"{here}: ") for line in str(error).splitlines())
        raise InputError("\n".join(_name_option(line, model_options) for line in lines)) from error


def _annotation(option: ModelOption, defaults: BaseModel) -> Any:
    default: Any = defaults
    for key in option.path:
        default = getattr(default, key)
    shown = _format_default(default)
    text = " ".join(option.description.split())
    is_flag = option.field.annotation is bool
    option = typer.Option(
        f"{option.option}/--no-{option.option[2:]}" if is_flag else option.option,
        metavar=None if is_flag else _metavar(option.field.annotation),
        help=escape(f"{text} [default: {shown}]" if shown else text),
        rich_help_panel=option.panel,
        show_default=False,
    )
    return Annotated[bool | None if is_flag else str | None, option]


def _format_default(default: Any) -> str:
    """A default as typed on the command line."""
    if isinstance(default, bool):
        return "yes" if default else "no"
    if isinstance(default, tuple) and default and isinstance(default[0], BaseModel):
        return json.dumps([item.model_dump(mode="json") for item in default]).replace('"', "")
    if isinstance(default, tuple):
        return ",".join(f"{item:g}" for item in default)
    if isinstance(default, float):
        return f"{round(default, 4):.12g}"
    return "" if default is None else str(default)


def _metavar(annotation: Any) -> str:
    kind = unwrap_annotation(annotation)
    if get_origin(kind) is Literal:
        return list_choices(kind)
    if get_origin(kind) is tuple:
        return "N,N,..." if unwrap_annotation(get_args(kind)[0]) in (int, float) else "YAML"
    return {int: "INT", float: "N", str: "TEXT"}.get(kind, "YAML")


def _parse_value(option: ModelOption, value: Any) -> Any:
    """The value of an option; text that is not a number stays text, which the model then rejects."""
    if isinstance(value, bool):
        return value
    metavar = _metavar(option.field.annotation)
    if metavar == "YAML":
        return parse_value(option.option, value)
    if metavar == "N,N,...":
        return [_parse_number(part) for part in value.split(",") if part.strip()]
    return _parse_number(value) if metavar in ("INT", "N") else value


def _parse_number(text: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _name_option(line: str, model_options: Mapping[str, ModelOption]) -> str:
    """An error about a key, ``camera.rate: ...``, as an error about the option that sets it."""
    groups = {one.path[0]: f"--{one.path[0]}-*" for one in model_options.values() if len(one.path) > 1}
    by_key = groups | {".".join(one.path): one.option for one in model_options.values()} | {"the file": "options"}
    for key in sorted(by_key, key=len, reverse=True):
        if match := re.match(rf"(unknown key )?{re.escape(key)}(?=[:.\[])", line):
            return f"{match[1] or ''}{by_key[key]}{line[match.end() :]}"
    return line
