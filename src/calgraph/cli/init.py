"""``calgraph init``: a first rig.yaml from a recording."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from calgraph.captures import find_empty_start
from calgraph.cli.common_options import OneRecording
from calgraph.cli.console import console
from calgraph.cli.setting_options import SetOption, parse_limits
from calgraph.config import FoundBackground, FoundTopic, draft_rig
from calgraph.config.settings import EmptyStartSettings
from calgraph.errors import InputError
from calgraph.io import write_text
from calgraph.printing import format_target, read_boards
from calgraph.recording import Recording, find_topics, open_recording


def init(
    recording: OneRecording,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="File to write.")] = Path("rig.yaml"),
    board: Annotated[
        Path | None,
        typer.Option(
            "--board",
            metavar="FILE",
            help="Take the target from this file: what calgraph board printed, or a rig.yaml.",
        ),
    ] = None,
    overrides: SetOption = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite FILE if it exists.")] = False,
) -> None:
    """Draft a rig.yaml from the topics of a recording, with comments on what to check and to measure."""
    if out.exists() and not force:
        raise InputError(f"{out}: exists already; choose another FILE, or give --force to overwrite it")
    target = format_target(read_boards(board)) if board else ""
    with open_recording(recording, parse_limits(overrides, alone=True)) as opened:
        topics = find_topics(opened)
        text = draft_rig(topics, str(recording), target, _find_background(opened, topics))
    write_text(out, text)
    todo = "go through its comments" if board else "state your board in it, and go through its comments"
    console(stderr=True).print(f"Wrote {out}: {todo}", markup=False)


def _find_background(recording: Recording, topics: Sequence[FoundTopic]) -> FoundBackground | None:
    """The time without board and operator at the start of a recording."""
    usable = [t.name for t in topics if t.kind in ("lidar2d", "lidar3d") and t.count and not t.problem]
    found = find_empty_start(recording, usable, settings=EmptyStartSettings())
    if found is None:
        return None
    return FoundBackground(found.end, f"{found.topic} changes at {found.entry:.1f} s")
