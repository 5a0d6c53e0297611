"""``calgraph check``: whether given extrinsics still hold, by a recording."""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.markup import escape

from calgraph.calibration.dispatch import compare
from calgraph.calibration.result_files import format_comparison, write_results
from calgraph.cli.cache import open_cache
from calgraph.cli.common_options import (
    RESULT_FILES,
    ClusterOption,
    ForceOption,
    NoCacheOption,
    RigFile,
    SeedOption,
    check_not_overwriting,
    open_engine,
)
from calgraph.cli.console import console, make_table
from calgraph.cli.printing import print_remarks, print_remedies
from calgraph.cli.progress import progress_bars
from calgraph.cli.setting_options import SetOption, load_rig_with
from calgraph.config import Rig, Tolerance
from calgraph.errors import InputError
from calgraph.io.atomic import replace_folder_atomically, write_text
from calgraph.io.yaml_reading import validate_content
from calgraph.parallel.engine import Engine
from calgraph.recording import RecordingCache, open_recordings
from calgraph.result import Calibration, ExtrinsicsFile, read_extrinsics

if TYPE_CHECKING:
    from calgraph.verdict.comparison import ExtrinsicsComparison, ResidualComparison

_SIGNS = {"pass": "[green]✓[/]", "warn": "[yellow]![/]", "fail": "[red]✕[/]", "undecided": "[yellow]?[/]"}
"""Sign for each outcome, and for an undecided axis: colour is never the only one."""
_LEGEND = {
    "pass": "within the tolerance of {tolerance}",
    "undecided": "not decided: σ is too large for this tolerance",
    "warn": "a warning: see below",
    "fail": "off by more than the tolerance",
}
"""What the marks of the table mean."""


def check(
    rig_file: RigFile,
    recordings: Annotated[
        list[str],
        typer.Argument(metavar="RECORDING...", help="As for calibrate; or what calibrate --dump wrote (.npz)."),
    ],
    against: Annotated[
        Path,
        typer.Option(metavar="FILE", help="The extrinsics: calibration.yaml, URDF, or transforms of tf (YAML)."),
    ],
    tolerance: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="M DEG", help="Acceptable errors, m and degrees. [default: that of RIG.yaml, or 0.01 0.3]"
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="OUT", help="Folder for check.json, and the estimated calibration."),
    ] = None,
    force: ForceOption = False,
    seed: SeedOption = 0,
    overrides: SetOption = None,
    cluster: ClusterOption = None,
    no_cache: NoCacheOption = False,
    json: Annotated[bool, typer.Option("--json", help="Print check.json.")] = False,
) -> None:
    """Check given extrinsics of a rig or network by a recording: pass, warn or fail, by sensor and axis, and why.

    A sensor fails along an axis if the error of FILE exceeds the tolerance and is
    significant. Warnings: a significant error within the tolerance, or a recording
    that does not decide. Of a network, the smallest set of scanners whose movement
    explains the differences is named: a minute of ordinary traffic is sufficient.
    Of a robot that drives, a minute of ordinary driving is.

    Exit code 0: pass or warn; 1: a sensor fails, or nothing could be calibrated; 2: invalid input.
    """
    if out:
        check_not_overwriting(out, [*RESULT_FILES, "check.json"], force=force)
    rig, given = _set_tolerance(load_rig_with(rig_file, overrides), tolerance), read_extrinsics(against)
    with replace_folder_atomically(out, "calibration.yaml") if out else nullcontext() as folder:
        cache = open_cache(unused=no_cache)
        with open_engine(None, cluster, rig.settings.cluster) as engine:
            calibration, audit, rig = _compare(rig, recordings, given, seed, cache, engine)
        content = format_comparison(audit, against, rig.tolerance)
        if folder:
            write_results(calibration, rig, folder)
            write_text(folder / "check.json", content + "\n")
    if json:
        typer.echo(content)
    else:
        _print(audit, against, rig.root, rig.tolerance)
        print_remarks(calibration)
        print_remedies(calibration, audit.remedy)
        _print_next_step(audit, out)
    if audit.outcome == "fail":
        raise typer.Exit(1)


def _set_tolerance(rig: Rig, tolerance: tuple[float, float] | None) -> Rig:
    """The rig with the tolerance of the option (m, degrees), where that is given."""
    if tolerance is None:
        return rig
    if not (min(tolerance) > 0 and np.isfinite(tolerance).all()):
        raise InputError(
            f"--tolerance: must be two numbers above 0, m and degrees, got {tolerance[0]:g} {tolerance[1]:g}"
        )
    content = {"translation": tolerance[0], "rotation": tolerance[1]}
    return rig.model_copy(update={"tolerance": validate_content(Tolerance, content, Path("--tolerance"))})


def _compare(
    rig: Rig, recordings: list[str], given: ExtrinsicsFile, seed: int, cache: RecordingCache, engine: Engine
) -> tuple[Calibration, "ExtrinsicsComparison", Rig]:
    """The calibration from the recording or dump, the comparison with the given poses, and the resolved rig."""
    from calgraph.rig.bundle.problem import check_problem
    from calgraph.rig.bundle.problem_file import load_problem
    from calgraph.rig.verification import compare_extrinsics

    dumped = any(Path(file).suffix == ".npz" and Path(file).is_file() for file in recordings)
    if dumped and not (rig.is_network or rig.is_drive):
        if len(recordings) > 1:
            raise InputError(f"{recordings[0]}: a dump is one recording's, got {len(recordings)} files")
        problem = replace(load_problem(Path(recordings[0]), rig.settings.limits), rig=rig)
        check_problem(problem)
        return *compare_extrinsics(problem, given), rig
    with open_recordings(recordings, rig.settings.limits) as recording, progress_bars() as progress:
        return compare(rig, recording, given, seed=seed, engine=engine, cache=cache, progress=progress)


def _print(audit: "ExtrinsicsComparison", against: Path, root: str, tolerance: Tolerance) -> None:
    """A row per sensor: given minus estimated pose, along its axes; what the marks mean; the outcome of each."""
    output = console()
    output.print(f"[bold]{escape(str(against))} minus the estimated poses[/], along each sensor's axes")
    rows = []
    marks: set[str] = {sensor.outcome for sensor in audit.sensors}
    for sensor in audit.sensors:
        cells = []
        for i, axis in enumerate(sensor.axes):
            mark = "undecided" if axis.undecided else axis.outcome
            marks |= {mark}
            value, digits = (1000 * axis.offset, 1) if i < 3 else (float(np.degrees(axis.offset)), 2)
            offset = f"{round(value, digits) + 0.0:+.{digits}f}{'' if mark == 'pass' else _SIGNS[mark]}"
            cells.append(offset if np.isfinite(axis.stddev) else "")
        outcome = _SIGNS[sensor.outcome]
        rows.append((escape(sensor.sensor), *(cells or [""] * 6), _misfit(sensor.misfit), outcome))
    rows.append((escape(audit.reference), *[""] * 6, _misfit(audit.misfit), ""))
    numbers = ("x mm", "y mm", "z mm", "rx °", "ry °", "rz °", "residual", "")
    output.print(make_table(["sensor"], numbers, rows, gap=2))
    residual = "; residual: with this file / as estimated" if audit.misfit else ""
    output.print(f"All in the frame of {escape(audit.reference)}{residual}")
    limits = f"{1000 * tolerance.translation:g} mm and {tolerance.rotation:g}°"
    legend = (f"{_SIGNS[m]} {text.format(tolerance=limits)}" for m, text in _LEGEND.items() if m in marks)
    output.print("; ".join(legend))
    if audit.reference != root:
        output.print(f"Relative to {escape(root)}, several sensors are off: either it has moved, or they have.")
    for sensor in audit.sensors:
        outcome = f"{sensor.sensor}: {sensor.outcome}{': ' if sensor.reason else ''}{sensor.reason}"
        output.print(f"{_SIGNS[sensor.outcome]} {escape(outcome)}")


def _print_next_step(audit: "ExtrinsicsComparison", out: Path | None) -> None:
    """What to do about sensors that fail, and about undecided ones."""
    if audit.failed:
        poses = f"take the new poses from {out}" if out else "take the new poses, which --out writes"
        step = f"mount {', '.join(audit.failed)} as before, or {poses}"
        console().print(f"[bold]To do:[/] {escape(step)}")
    if audit.remedy:
        console().print(f"[bold]To decide:[/] {escape(audit.remedy)}")


def _misfit(misfit: "ResidualComparison | None") -> str:
    if misfit is None:
        return ""
    scale, digits, unit = (1, 2, "px") if misfit.unit == "px" else (1000, 1, "mm")
    given = f"{scale * misfit.given:.{digits}f}" if np.isfinite(misfit.given) else "∞"
    return f"{given}/{scale * misfit.found:.{digits}f} {unit}"
