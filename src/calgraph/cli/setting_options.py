"""The option ``--set``, which overrides single settings of a rig.yaml."""

from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from calgraph.cli.common_options import tuning
from calgraph.errors import InputError

if TYPE_CHECKING:
    from calgraph.config import Rig
    from calgraph.config.settings import LimitSettings, PublishedSettings, Settings


def list_settings() -> list[str]:
    """The keys of all settings, such as ``captures.min_hold``."""
    from calgraph.config.settings import Settings
    from calgraph.io.field_docs import walk_fields

    return [".".join(keys) for keys, _ in walk_fields(Settings)]


def _complete(incomplete: str) -> list[str]:
    """What a shell offers for the option."""
    return [f"{key}=" for key in list_settings() if key.startswith(incomplete)]


SetOption = Annotated[
    list[str] | None,
    tuning(
        "--set",
        metavar="KEY=VALUE",
        autocompletion=_complete,
        help="Override a setting, such as captures.min_hold=2; repeatable. rig.resolved.yaml lists all.",
    ),
]


def load_rig_with(path: Path, assignments: Sequence[str] | None) -> "Rig":
    """Reads a rig.yaml, and overrides settings; raises InputError as :func:`override_settings` does."""
    from calgraph.config import load_rig

    if path.is_dir() or path.suffix in (".mcap", ".db3", ".bag"):
        raise InputError(f"{path}: seems to be a recording; give RIG.yaml first, then the recordings")
    return override_settings(load_rig(path), assignments)


def parse_limits(assignments: Sequence[str] | None, *, alone: bool = False) -> "LimitSettings":
    """The limits among the assignments, for files that are read before a rig is known.

    Args:
        assignments: as :func:`override_settings` takes them.
        alone: whether no other setting is of use to the command.

    Raises:
        InputError: an assignment of a limit is invalid, or no other is of use.
    """
    from calgraph.config.settings import Settings

    limits = [text for text in assignments or () if text.strip().startswith("limits.")]
    if alone and len(limits) < len(assignments or ()):
        other = next(text for text in assignments or () if text not in limits)
        raise InputError(f"--set: only limits are of use here, such as limits.max_image_pixels=1e9, got {other!r}")
    return _override(Settings(), limits).limits


def parse_published(assignments: Sequence[str] | None) -> "PublishedSettings":
    """The settings ``published`` among the assignments; raises InputError as :func:`override_settings` does."""
    from calgraph.config.settings import Settings

    stated = [text for text in assignments or () if text.partition("=")[0].split(".")[0].strip() == "published"]
    return _override(Settings(), stated).published


def override_settings(rig: "Rig", assignments: Sequence[str] | None) -> "Rig":
    """The rig with some settings replaced.

    Args:
        rig: the rig.
        assignments: each a key below ``settings`` in rig.yaml, ``=``, and its value as YAML.

    Raises:
        InputError: an assignment is malformed, or its key or value is invalid.
    """
    return rig.model_copy(update={"settings": _override(rig.settings, assignments)}) if assignments else rig


def _override(settings: "Settings", assignments: Sequence[str]) -> "Settings":
    from calgraph.config import Rig
    from calgraph.config.settings import Settings
    from calgraph.io.yaml_reading import validate_content

    content = settings.model_dump(mode="json", exclude_none=True)
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        if not key or not equals:
            raise InputError(f"--set: must be KEY=VALUE, such as captures.min_hold=2, got {assignment!r}")
        path = key.strip().split(".")
        if path[0] in Rig.model_fields and not get_close_matches(path[0], Settings.model_fields):
            raise InputError(f"--set: {path[0]} is a key of rig.yaml and no setting; change it there")
        set_nested(content, path, parse_value("--set", text, f"the value of {key[:60]} "))
    return validate_content(Settings, content, Path("--set"))


def parse_value(option: str, text: str, what: str = "") -> Any:
    """The value of an option in YAML.

    Raises:
        InputError: it is none.
    """
    from calgraph.io.yaml_limits import MAX_RIG_VALUES
    from calgraph.io.yaml_reading import parse_yaml

    try:
        return parse_yaml(text, Path(option), MAX_RIG_VALUES)
    except InputError as error:
        raise InputError(f"{option}: {what}is not valid YAML, got {text[:60]!r}") from error


def set_nested(content: dict[str, Any], path: Sequence[str], value: Any) -> None:
    """Sets a value in nested mappings; a key below a value that is none replaces it, which validation rejects."""
    *above, last = path
    for name in above:
        if not isinstance(content.get(name), dict):
            content[name] = {}
        content = content[name]
    content[last] = value
