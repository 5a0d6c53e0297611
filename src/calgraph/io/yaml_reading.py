"""YAML files checked against a model, with errors that name file, key, value and what is allowed.

pydantic reports the location of an error with tags of unions and names of types. Here the location is followed
along the model's types, which gives the key as written in the file and the keys allowed at that level.
"""

import difflib
import os
import re
import types
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import pydantic
from pydantic import BaseModel
from pydantic_core import ErrorDetails
from ruamel.yaml.constructor import DuplicateKeyError
from ruamel.yaml.error import MarkedYAMLError, ReusedAnchorWarning, YAMLError

from calgraph.errors import InputError
from calgraph.io.field_docs import describe_field
from calgraph.io.git_lfs import check_git_lfs
from calgraph.io.yaml_limits import MAX_TEXT_BYTES, MAX_VALUES, create_limited_yaml

Model = TypeVar("Model", bound=BaseModel)

_YAML_ERRORS = (YAMLError, ValueError, TypeError, LookupError, OverflowError)
"""What ruamel raises: all but the first for scalars that are not of the type they are tagged with, such as a date
in a 13th month, and for keys that cannot be hashed."""
_MAX_LISTED_ERRORS = 50
"""More wrong keys or values in one file are counted, not listed."""
_MAX_PROBLEM_LENGTH = 200
"""Characters of a message of the YAML library."""
_MAX_VALUE_LENGTH = 60
"""Characters of a value in a message."""


def read_yaml(path: Path, max_values: int = MAX_VALUES) -> dict[Any, Any]:
    """The mapping in a YAML file.

    Args:
        path: the file.
        max_values: the most values in it.

    Raises:
        InputError: the file is missing, is not YAML, gives a key twice, does not contain a mapping, or exceeds a
            limit of :mod:`calgraph.io.yaml_limits`.
    """
    content = parse_yaml(read_text(path), path, max_values)
    if not isinstance(content, dict):
        raise InputError(f"{path}: must hold a mapping of keys to values, not {_format_value(content)}")
    return content


def parse_yaml(text: str, source: Path, max_values: int = MAX_VALUES) -> Any:
    """The value of a text in YAML.

    Args:
        text: the YAML.
        source: the file or the option that it is from, with which messages start.
        max_values: the most values in it.

    Raises:
        InputError: it is not YAML, gives a key twice, or exceeds a limit of :mod:`calgraph.io.yaml_limits`.
    """
    with _wrap_yaml_errors(source):
        # OpenCV 3 and before begin with a line that is no directive of YAML, and leave out the line after it.
        return create_limited_yaml(source, max_values).load(re.sub(r"\A%YAML:[^\n]*", "", text))


def read_documents(path: Path) -> list[Any]:
    """All documents of a YAML file, empty ones left out, such as a recorded stream of messages.

    Raises:
        InputError: the file is missing, is not YAML, gives a key twice, or exceeds a limit of
            :mod:`calgraph.io.yaml_limits`.
    """
    text = read_text(path)
    with _wrap_yaml_errors(path):
        return [content for content in create_limited_yaml(path).load_all(text) if content is not None]


@contextmanager
def _wrap_yaml_errors(source: Path) -> Iterator[None]:
    """Converts exceptions of ruamel; leaves out its warning of anchors that are used again, which YAML allows."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ReusedAnchorWarning)
        try:
            yield
        except _YAML_ERRORS as error:
            raise InputError(f"{source}{_explain_syntax(error)}") from error


def read_text(path: Path) -> str:
    """The text of a file.

    Raises:
        InputError: the file is missing, is too large, or is not UTF-8.
    """
    try:
        with path.open("rb") as file:
            # Pipes and devices state no size; Python takes the memory for as many bytes as are asked for.
            size = os.fstat(file.fileno()).st_size or MAX_TEXT_BYTES
            data = file.read(min(size, MAX_TEXT_BYTES) + 1)
        if len(data) > MAX_TEXT_BYTES:
            raise InputError(f"{path}: is larger than {MAX_TEXT_BYTES // 10**6} MB; is it the right file?")
        text = data.decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
    except FileNotFoundError as error:
        raise InputError(f"{path}: does not exist{suggest_name(path)}") from error
    except IsADirectoryError as error:
        raise InputError(f"{path}: is a folder; give a file in it") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8 text (byte {error.start})") from error
    check_git_lfs(path, text[:100].encode())
    return text


def suggest_name(path: Path) -> str:
    """The end of a message that a path does not exist: the most similar name beside it, if there is one."""
    beside = [one.name for one in path.parent.iterdir()] if path.parent.is_dir() else []
    close = difflib.get_close_matches(path.name, beside, n=1, cutoff=0.6)
    return f"; did you mean {str(path.parent / close[0])!r}?" if close else "; check the path"


def validate_content(model: type[Model], content: dict[Any, Any], source: Path) -> Model:
    """``content`` as a ``model``.

    Raises:
        InputError: with one line for each invalid key or value, starting with ``source``.
    """
    try:
        return model.model_validate(content)
    except pydantic.ValidationError as error:
        # pydantic also reports a list with invalid elements as empty.
        details = [d for d in error.errors() if d["type"] != "too_short" or not d["input"]]
        lines = list(dict.fromkeys(f"{source}: {_explain(model, d)}" for d in details[:_MAX_LISTED_ERRORS]))
        if len(details) > _MAX_LISTED_ERRORS:
            lines.append(f"{source}: has {len(details) - _MAX_LISTED_ERRORS} further errors")
        raise InputError("\n".join(lines)) from error


def _explain_syntax(error: Exception) -> str:
    mark = error.problem_mark if isinstance(error, MarkedYAMLError) else None
    where = f", line {mark.line + 1}: " if mark else ": "
    if isinstance(error, DuplicateKeyError):
        key = str(error.problem).split('"')[1]
        return f"{where}the key {key!r} is given twice"
    problem = (
        error.problem
        if isinstance(error, MarkedYAMLError) and error.problem
        else " ".join(str(error).split())[:_MAX_PROBLEM_LENGTH]
    )
    return f"{where}is not valid YAML ({problem})"


@dataclass(frozen=True)
class _Location:
    """Where in the file an error is."""

    path: list[Any]
    """Keys and indices as in the file."""
    owner: type | None
    """The model or dataclass that the last key belongs to."""
    around: Any
    """The type of what holds the last key or index."""
    annotation: Any
    """The type of the value there."""


def _explain(model: type[BaseModel], details: ErrorDetails) -> str:
    place = _locate(model, details["loc"])
    path, owner = place.path, place.owner
    kind, given, context = details["type"], details["input"], details.get("ctx", {})
    if kind == "calgraph":
        return f"{_format_path([*path, context['key']])}: {context['message']}"
    if kind in ("extra_forbidden", "unexpected_keyword_argument") and owner is not None:
        return f"unknown key {_format_path(path)}{_suggest_key(path[-1], _list_fields(owner))}"
    if kind == "missing" and path and isinstance(path[-1], int):
        # pydantic reports each absent element of a fixed-length list; the message names the list.
        count = len(get_args(place.around))
        return f"{_format_path(path[:-1])}: must have {count} elements, got {_format_value(given)}"
    if kind == "missing":
        return f"{_format_path(path)}: is missing{_describe_field(owner, path)}"
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        return _explain_kind(path, given, _allowed_kinds(place.annotation))
    if kind == "dict_type" and isinstance(given, list):
        return f"{_format_path(path)}: must be a mapping, in which the name of each is its key, got a list"
    allowed = _describe_constraint(kind, context) or _lowercase_first(details["msg"])
    if kind == "value_error" and isinstance(given, dict):
        # The validator of a whole part names the contradicting values itself.
        return f"{_format_path(path)}: {allowed}"
    return f"{_format_path(path)}: {allowed}, got {_format_value(given)}"


def _explain_kind(path: list[Any], given: Any, allowed: list[str]) -> str:
    """A part with alternatives whose key ``kind`` is absent or not one of them."""
    listed = ", ".join(allowed)
    if not isinstance(given, dict):
        return f"{_format_path(path)}: must be a mapping with the key kind ({listed}), got {_format_value(given)}"
    if "kind" not in given:
        return f"{_format_path([*path, 'kind'])}: is missing; allowed are {listed}"
    close = difflib.get_close_matches(str(given["kind"]), allowed, n=1, cutoff=0.6)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    return f"{_format_path([*path, 'kind'])}: must be one of {listed}, got {_format_value(given['kind'])}{hint}"


_TYPES = {
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "float_parsing": "must be a number",
    "int_parsing": "must be a whole number",
    "string_type": "must be a text",
    "bool_type": "must be true or false",
    "finite_number": "must be a finite number",
    "tuple_type": "must be a list",
    "list_type": "must be a list",
    "dict_type": "must be a mapping",
    "model_type": "must be a mapping",
    "dataclass_type": "must be a mapping",
    "model_attributes_type": "must be a mapping",
    "too_short": "must not be empty",
    "string_too_short": "must not be empty",
    "string_pattern_mismatch": "must have no control characters",
    "invalid_key": "must have texts as keys",
}
_LIMITS = {
    "greater_than": "must be greater than {gt}",
    "greater_than_equal": "must be {ge} or greater",
    "less_than": "must be less than {lt}",
    "less_than_equal": "must be {le} or less",
    "literal_error": "must be {expected}",
    "too_long": "must have {max_length} elements",
    "string_too_long": "must have {max_length} characters or fewer",
}


def _describe_constraint(kind: str, context: dict[str, Any]) -> str | None:
    numbers = {key: f"{value:g}" if isinstance(value, float) else value for key, value in context.items()}
    return _TYPES.get(kind) or (_LIMITS[kind].format(**numbers) if kind in _LIMITS else None)


def _lowercase_first(message: str) -> str:
    message = message.removeprefix("Value error, ")
    return message[:1].lower() + message[1:]


def _format_value(value: object) -> str:
    """A value in the form it has in the file."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return "a mapping" if value else "an empty mapping"
    text = repr(value)
    return text if len(text) <= _MAX_VALUE_LENGTH else f"{text[: _MAX_VALUE_LENGTH - 3]}..."


def _describe_field(owner: type | None, path: list[Any]) -> str:
    description = describe_field(owner, str(path[-1])) if owner else ""
    return f" ({description.splitlines()[0].rstrip('.')})" if description else ""


def _suggest_key(key: Any, allowed: Iterable[str]) -> str:
    close = difflib.get_close_matches(str(key), allowed, n=1, cutoff=0.6)
    return f"; did you mean {close[0]!r}?" if close else f"; allowed here are {', '.join(allowed)}"


def _format_path(path: list[Any]) -> str:
    """The path in dotted notation: ``target.tags[0].size``."""
    parts = [f"[{part}]" if isinstance(part, int) else f".{_format_key(str(part))}" for part in path if part != ""]
    return "".join(parts).lstrip(".") or "the file"


def _format_key(key: str) -> str:
    """A key as it stands in the file, unless it is too long for a message, or has control characters."""
    return key if len(key) <= _MAX_VALUE_LENGTH and key.isprintable() else _format_value(key)


def _locate(model: type[BaseModel], location: tuple[int | str, ...]) -> _Location:
    """The place in the file, and in the types, of pydantic's location."""
    annotation: Any = model
    around: Any = None
    path: list[Any] = []
    owner: type | None = None
    for part in location:
        annotation = unwrap_annotation(annotation)
        if part == "[key]":
            break  # pydantic's marker of an invalid key
        if _union_members(annotation):
            annotation = next(
                (member for member in _union_members(annotation) if _discriminator_tag(member) == part), None
            )
            continue
        origin, around = get_origin(annotation), annotation
        if isinstance(annotation, type) and (fields := _list_fields(annotation)):
            owner, annotation = annotation, fields.get(str(part))
        elif origin is dict:
            owner, annotation = None, get_args(annotation)[1]
        elif origin is tuple and isinstance(part, int):
            owner, annotation = None, get_args(annotation)[0]
        else:
            break  # markers that pydantic adds
        path.append(part)
    return _Location(path, owner, around, unwrap_annotation(annotation))


def _list_fields(owner: type) -> dict[str, Any]:
    """The types of the fields of a model or a dataclass; none of other types."""
    if issubclass(owner, BaseModel):
        return {name: field.annotation for name, field in owner.model_fields.items()}
    return get_type_hints(owner, include_extras=True) if is_dataclass(owner) else {}


def unwrap_annotation(annotation: Any) -> Any:
    """A type without its constraints and without the None of an optional value."""
    while get_origin(annotation) is Annotated:
        annotation = get_args(annotation)[0]
    members = _union_members(annotation)
    return unwrap_annotation(members[0]) if len(members) == 1 else annotation


def _union_members(annotation: Any) -> list[Any]:
    """The alternatives of a union; none for any other type."""
    if get_origin(annotation) not in (Union, types.UnionType):
        return []
    return [member for member in get_args(annotation) if member is not type(None)]


def _discriminator_tag(member: Any) -> str | None:
    """The tag by which a union chooses ``member``: stated, or the one value of its key kind."""
    if get_origin(member) is Annotated:
        inner, *metadata = get_args(member)
        return next((m.tag for m in metadata if isinstance(m, pydantic.Tag)), _discriminator_tag(inner))
    return _kind_of_model(member)


def _kind_of_model(member: Any) -> str | None:
    model = unwrap_annotation(member)
    is_model = isinstance(model, type) and issubclass(model, BaseModel) and "kind" in model.model_fields
    return str(get_args(model.model_fields["kind"].annotation)[0]) if is_model else None


def _allowed_kinds(annotation: Any) -> list[str]:
    """The values that ``kind`` may have in a union of models."""
    return [kind for member in _union_members(annotation) if (kind := _kind_of_model(member))]
