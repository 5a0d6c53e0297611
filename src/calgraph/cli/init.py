"""``calgraph init``: a first rig.yaml from a recording."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from calgraph.cli.common_options import OneRecording
from calgraph.cli.console import console
from calgraph.cli.setting_options import SetOption, parse_limits
from calgraph.config import Board, Capture, FoundBackground, FoundMode, FoundTopic, draft_rig, find_triggers
from calgraph.config.settings import CameraDetectionSettings, CaptureSettings
from calgraph.errors import InputError
from calgraph.io.atomic import write_text
from calgraph.printing import format_target, read_boards
from calgraph.recording import Recording, correct_stamps, find_topics, open_recording
from calgraph.recording.clocks import compare_clocks
from calgraph.rig.captures.capture_mode import recognize_recording
from calgraph.rig.captures.empty_start import find_empty_start
from calgraph.sensors.kinds import KINDS


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
    boards = read_boards(board) if board else ()
    target = format_target(boards) if boards else ""
    with open_recording(recording, parse_limits(overrides, alone=True)) as opened:
        topics = find_topics(opened)
        timed = [topic.name for topic in topics if topic.kind in KINDS or topic in find_triggers(topics)[0]]
        clocks = compare_clocks(opened, timed)
        by_one_clock = correct_stamps(opened, clocks.certain_offsets())
        background = _find_background(by_one_clock, topics, boards)
        mode = _find_mode(by_one_clock, topics, background.end if background else 0.0)
        text = draft_rig(topics, recording, target, background, mode)
    write_text(out, text)
    todo = "go through its comments" if board else "state your board in it, and go through its comments"
    console(stderr=True).print(f"Wrote {out}: {todo}", markup=False)


def _find_mode(recording: Recording, topics: Sequence[FoundTopic], empty_end: float) -> FoundMode | None:
    """How the recording shows the board; None where a topic seems to mark the captures."""
    if find_triggers(topics)[0]:
        return None
    usable = [t.name for t in topics if t.kind in KINDS and t.count and not t.problem]
    found = recognize_recording(recording, usable, settings=CaptureSettings(), empty_end=empty_end)
    return FoundMode(found.mode, found.reason) if found else None


def _find_background(
    recording: Recording, topics: Sequence[FoundTopic], boards: Sequence[Board]
) -> FoundBackground | None:
    """The time without board and operator at the start of a recording."""
    usable = [t for t in topics if t.kind in KINDS and t.count and not t.problem]
    scanners, cameras = (
        [t.name for t in usable if KINDS[t.kind].measures_ranges == measuring] for measuring in (True, False)
    )
    triggers = find_triggers(topics)[0]
    capture = Capture(trigger=triggers[0].name if triggers else None)
    found = find_empty_start(
        recording, scanners, cameras, boards, capture,
        settings=CaptureSettings(), camera_settings=CameraDetectionSettings(),
    )  # fmt: skip
    if found is None:
        return None
    entry = f"found automatically, as {found.topic} changes at {found.entry:.1f} s"
    return FoundBackground(found.end, entry, searched=bool(boards) or not cameras)
