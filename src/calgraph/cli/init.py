"""``calgraph init``: a first rig.yaml from a recording."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from calgraph.cli.common_options import OneRecording
from calgraph.cli.console import console
from calgraph.cli.setting_options import SetOption, parse_limits
from calgraph.config import Board, Capture, FoundBackground, FoundTopic, draft_rig, find_triggers
from calgraph.config.settings import CameraDetectionSettings, CaptureSettings
from calgraph.errors import InputError
from calgraph.io.atomic import write_text
from calgraph.printing import format_target, read_boards
from calgraph.recording import Recording, correct_stamps, find_topics, open_recording
from calgraph.recording.clocks import compare_clocks
from calgraph.recording.moving_robot import find_building_network, find_moving_robot
from calgraph.rig.captures.capture_mode import RecognizedMode, recognize_recording
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
        by_one_clock = correct_stamps(opened, compare_clocks(opened, timed).certain_offsets())
        robot = "" if boards else find_moving_robot(by_one_clock, topics)
        network = "" if boards or robot else find_building_network(by_one_clock, topics)
        boardless = robot or network
        background = None if boardless else find_background(by_one_clock, topics, boards)
        found = None if boardless else find_mode(by_one_clock, topics, background)
        mode = (found.mode, found.reason) if found else None
        text = draft_rig(topics, recording, target, background, mode, robot, network)
    write_text(out, text)
    todo = f"{'' if board or boardless else 'state your board in it, and '}go through its comments"
    if robot:
        todo += f"; it is of a robot that drives, as {robot}"
    if network:
        todo += f"; it is of LiDARs that are fixed in a building, as {network}"
    console(stderr=True).print(f"Wrote {out}: {todo}", markup=False)


def find_mode(
    recording: Recording, topics: Sequence[FoundTopic], background: FoundBackground | None
) -> RecognizedMode | None:
    """How the recording shows the board.

    None where a topic seems to mark the captures, for one sensor, and for networks of 2-D scanners.
    """
    usable = _list_usable(topics)
    if find_triggers(topics)[0] or all(KINDS[t.kind].detects == "line" for t in usable):
        return None
    return recognize_recording(
        recording, [t.name for t in usable], CaptureSettings(), background.end if background else 0.0
    )


def _list_usable(topics: Sequence[FoundTopic]) -> list[FoundTopic]:
    """Those of sensors whose messages can be decoded."""
    return [t for t in topics if t.kind in KINDS and t.count and not t.problem]


def find_background(
    recording: Recording, topics: Sequence[FoundTopic], boards: Sequence[Board]
) -> FoundBackground | None:
    """The time without board and operator at the start of a recording."""
    scanners, cameras = (
        [t.name for t in _list_usable(topics) if KINDS[t.kind].measures_ranges == measuring]
        for measuring in (True, False)
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
