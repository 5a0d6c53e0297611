"""The ``target:`` block of rig.yaml for a print: formatted, inserted into a file, and read back."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import model_validator
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from calgraph.config import AprilGrid, Board, Rig
from calgraph.config.board_ambiguity import check_boards_distinguishable
from calgraph.config.target import Target
from calgraph.errors import InputError
from calgraph.io.strict_model import StrictModel
from calgraph.io.text_writing import format_yaml
from calgraph.io.yaml_limits import MAX_RIG_VALUES
from calgraph.io.yaml_reading import read_text, read_yaml, validate_content

_COMMENT = """\
The printed board, in m. Measure the print with its rulers: printers change scales.
If it is glued to a larger plate, size is the plate's, and centers are relative to the plate's centre."""
# The key and its content: indented lines and dashes, with blank lines and comments between them.
_BLOCK = re.compile(r"^target:.*\n(?:(?:[ \t]*(?:#.*)?\n)*(?:[ \t]+\S.*|-.*)(?:\n|\Z))*", re.MULTILINE)


class _TargetFile(StrictModel):
    """The part of a rig.yaml that a print needs."""

    target: Target

    @model_validator(mode="after")
    def _distinguishable(self) -> "_TargetFile":
        check_boards_distinguishable(self.target if isinstance(self.target, tuple) else ())
        return self


def format_target(boards: Sequence[Board]) -> str:
    """Formats ``target:`` with one board or a list of boards, as YAML with a comment."""
    plain = [_board_content(board) for board in boards]
    return format_yaml({"target": plain[0] if len(plain) == 1 else plain}, _COMMENT)


def replace_target(path: Path, boards: Sequence[Board]) -> str:
    """The text of a rig.yaml with another target; everything else, comments too, is unchanged.

    Raises:
        InputError: the file is no valid rig.yaml, or not with these boards.
    """
    text, before = read_text(path), read_yaml(path, MAX_RIG_VALUES)
    block = format_target(boards)
    text = text if text.endswith("\n") else text + "\n"
    changed = _BLOCK.sub(lambda _: block, text, count=1) if _BLOCK.search(text) else text + block
    after = _parse_mapping(changed)
    if not after or {**after, "target": None} != {**before, "target": None}:
        raise InputError(f"{path}: the layout of its target block is not supported; replace the block by hand")
    validate_content(Rig, after, path)
    return changed


def read_boards(path: Path) -> tuple[Board, ...]:
    """The boards under ``target`` of a rig.yaml, or of a file that has only a target.

    Raises:
        InputError: it has none, or a wrong one.
    """
    content = read_yaml(path, MAX_RIG_VALUES)
    target = validate_content(
        _TargetFile, {key: content[key] for key in ("target",) if key in content}, path
    ).target
    if isinstance(target, Board):
        return (target,)
    if isinstance(target, tuple):
        return target
    raise InputError(f"{path}: target.kind: must be board to be printed, got {target.kind}")


def _parse_mapping(text: str) -> dict[str, Any]:
    """Parses a mapping; an empty one if the text is not YAML."""
    try:
        return dict(YAML(typ="safe").load(text))
    except YAMLError:
        return {}


def _board_content(board: Board) -> dict[str, Any]:
    """The content of a board, without keys that do not apply to its pattern."""
    content = board.model_dump(mode="json", exclude_none=True)
    if not board.inverted:
        del content["inverted"]
    if board.pattern:
        del content["tags"]
        if not isinstance(board.pattern, AprilGrid):
            del content["family"]
    return content
