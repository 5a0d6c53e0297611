"""``calgraph plan``: the uncertainty of a rig's poses before it is recorded, and the best places for the board."""

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.markup import escape

from calgraph.cli.common_options import RigFile
from calgraph.cli.console import console, make_table
from calgraph.cli.setting_options import SetOption, load_rig_with
from calgraph.io.text_writing import format_json
from calgraph.verdict.grades import axis_names, describe_largest
from calgraph.verdict.remedy_choice import PROMISED_SHARE

if TYPE_CHECKING:
    from calgraph.geometry import Array
    from calgraph.rig.fields_of_view import PlannedRig
    from calgraph.rig.recording_plan import PlannedSensor, RecordingPlan

_FORMAT = "calgraph-plan/1"
_SIGNS = {"good": "[green]✓[/]", "more": "[yellow]![/]", "impossible": "[red]✕[/]"}
"""Sign for each judgement, so that colour is not the only distinction."""


def plan(
    rig_file: RigFile,
    captures: Annotated[
        int, typer.Option(min=5, max=10_000, metavar="N", help="Number of captures with the board in view of two.")
    ] = 40,
    poses: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Rough poses of all sensors: calibration.yaml, URDF, or transforms of tf (YAML). "
            "[default: side by side]",
        ),
    ] = None,
    recording: Annotated[
        str | None,
        typer.Option(
            metavar="RECORDING",
            help="Any recording of the sensors, for intrinsics and beams. [default: usual ones]",
        ),
    ] = None,
    overrides: SetOption = None,
    json: Annotated[bool, typer.Option("--json", help="Print the plan as JSON.")] = False,
) -> None:
    """Predict the errors of a rig's poses before recording, and list the best places for the board.

    The prediction is that of N captures, at places where two sensors or more detect the
    board, with the noise, the uncertainty and the tolerance that RIG.yaml states.

    Exit code 0: also where the tolerance cannot be met; 1: no two sensors detect the board; 2: invalid input.
    """
    from calgraph.recording import open_recordings
    from calgraph.result import read_extrinsics
    from calgraph.rig.fields_of_view import describe_rig
    from calgraph.rig.pipeline import check_board
    from calgraph.rig.recording_plan import plan_recording

    rig = load_rig_with(rig_file, overrides)
    check_board(rig)
    extrinsics = read_extrinsics(poses) if poses else None
    with open_recordings([recording], rig.settings.limits) if recording else nullcontext() as opened:
        planned = describe_rig(rig, extrinsics, opened)
    # The same draw of places each time: the prediction depends little on it.
    found = plan_recording(planned, captures, np.random.default_rng(0))
    if json:
        typer.echo(_format(found, planned))
    else:
        _print(found, planned)


def _format(found: "RecordingPlan", planned: "PlannedRig") -> str:
    """All numbers, m and rad."""
    sensors = {
        one.name: {
            "detected": one.detected,
            "axes": [
                {"axis": axis, "stddev": stddev, "limit": limit, "max_good_stddev": good}
                for axis, stddev, limit, good in zip(
                    axis_names(one.kind),
                    *(v.tolist() for v in (one.stddev, one.limit, found.max_stddev)),
                    strict=True,
                )
            ],
        }
        for one in found.sensors
    }
    places = [{"hold": one.hold, "T_root_board": one.T_root_board.tolist()} for one in found.places]
    content = {"format": _FORMAT, "captures": found.captures, "needed": found.needed, "sensors": sensors}
    return format_json({**content, "places": places, "assumptions": planned.assumptions}, indent=1)


def _print(found: "RecordingPlan", planned: "PlannedRig") -> None:
    """A row per sensor, what more captures cannot do and how many suffice, places, and assumptions."""
    output, tolerance = console(), planned.rig.tolerance
    output.print(f"[bold]Predicted errors of {found.captures} captures[/] (95 %, along and about the worst axis)")
    scale = tolerance.limits / found.max_stddev
    rows = [
        (
            escape(one.name), f"{one.detected:.0%}", *_format_worst(scale * one.stddev),
            *_format_worst(scale * one.limit), _SIGNS[found.judge(one)],
        )
        for one in found.sensors
    ]  # fmt: skip
    output.print(make_table(["sensor"], ("detects", "mm", "°", "at best mm", "°", ""), rows, gap=2))
    limits = f"{1000 * tolerance.translation:g} mm and {tolerance.rotation:g}°"
    output.print(f"{_SIGNS['good']} within the tolerance of {limits}; detects: share of the captures")
    output.print("at best: with any number of captures, by the uncertainty that rig.yaml states or defaults to")
    impossible = [one for one in found.sensors if found.judge(one) == "impossible"]
    for index, one in enumerate(found.sensors, start=1):
        if one in impossible:
            output.print(f"{_SIGNS['impossible']} {escape(_explain_limit(one, index, found, scale))}")
    if len(impossible) < len(found.sensors):
        others = "all sensors" if not impossible else "the others"
        enough = f"{found.needed} captures suffice" if found.needed else "500 captures do not suffice"
        reserve = f", with a reserve of {100 * (1 - PROMISED_SHARE):.0f} % if possible" if found.needed else ""
        output.print(f"[bold]{enough}[/] for {others}{reserve}")
    output.print(
        "[bold]Best places of the board[/], each in addition to those before; others all over the common view"
    )
    for number, place in enumerate(found.places, start=1):
        output.print(f"{number}. {escape(place.hold)}")
    for assumption in planned.assumptions:
        output.print(f"[yellow]![/] assumed, as not stated: {escape(assumption)}")


def _format_worst(errors: "Array") -> tuple[str, str]:
    """The largest of errors (6,) along and about axes, mm and degrees."""
    from calgraph.report.formatting import format_significant

    return format_significant(1000 * errors[:3].max()), format_significant(float(np.degrees(errors[3:].max())))


def _explain_limit(sensor: "PlannedSensor", index: int, found: "RecordingPlan", scale: "Array") -> str:
    """Why no number of captures suffices for a sensor, which has this index among all with the root."""
    from calgraph.report.formatting import format_angle, format_length

    if not sensor.detected:
        return f"{sensor.name}: no place of the board was found at which it and another sensor detect the board"
    worst = int(np.argmax(sensor.limit / found.max_stddev))
    error, allowed = (
        (format_length if worst < 3 else format_angle)(float(value))
        for value in (scale[worst] * sensor.limit[worst], scale[worst] * found.max_stddev[worst])
    )
    (source,) = describe_largest(found.limit_budget.shares_by_source(index), worst, "it")
    return (
        f"{sensor.name}: more captures cannot help: with any number of them, {axis_names(sensor.kind)[worst]} is "
        f"uncertain by {error} (95 %), beyond the tolerance of {allowed}; {source}; state smaller uncertainty in "
        "rig.yaml where you know it, or add a sensor"
    )
