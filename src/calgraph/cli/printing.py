"""Printing of a calibration: poses with standard deviations, for terminals of 80 columns and for pipes."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape

from calgraph.cli.console import console, make_table
from calgraph.config import Intrinsics
from calgraph.geometry import Array, se3
from calgraph.geometry.so3 import roll_pitch_yaw
from calgraph.result import (
    BaseFrame,
    Calibration,
    ErrorBudget,
    EstimatedParameter,
    Provenance,
    SensorPose,
    Verdict,
)
from calgraph.result.finding import share_clauses
from calgraph.sensors.kinds import KINDS

_GRADES = {"good": "[green]✓[/]", "weak": "[yellow]![/]", "unobservable": "[red]✕[/]"}
"""Sign for each grade, so that colour is not the only distinction."""
# Sensors whose gain by one action is stated: all of a rig, some of a network of 30 scanners.
_MAX_EFFECTS = 6


def print_calibration(calibration: Calibration) -> None:
    """Prints each sensor's pose, its standard deviation, its residuals, and its verdict."""
    output = console()
    output.print(f"[bold]Poses in the frame of {escape(calibration.root)}[/] (σ: along and about its worst axis)")
    _print_poses(output, calibration)
    if calibration.base is not None:
        _print_base(output, calibration.root, calibration.base)
    for sensor in calibration.sensors:
        if sensor.intrinsics is not None:
            _print_intrinsics(output, calibration, sensor.name, sensor.intrinsics)
    tolerance = calibration.evidence.tolerance
    others = [sensor for sensor in calibration.sensors if sensor.name != calibration.root]
    if tolerance and any(sensor.verdict.grade == "good" for sensor in others):
        limits = f"{1000 * tolerance.translation:g} mm and {tolerance.rotation:g}°"
        output.print(f"{_GRADES['good']} good: within the tolerance of {limits} along and about each axis (95 %)")
    if calibration.evidence.bodies:
        output.print(f"Targets: {calibration.evidence.bodies}")
    if any(_notable_parameters(calibration)):
        _print_systematic(output, calibration)
    if calibration.evidence.cross_validation:
        _print_cross_validation(output, calibration)
    elif calibration.evidence.fit:
        _print_fit(output, calibration)
    _print_verdicts(output, calibration)
    print_remarks(calibration)
    print_remedies(calibration)
    if any(sensor.verdict.grade != "good" for sensor in calibration.sensors):
        for number, suggestion in enumerate(calibration.evidence.suggestions, start=1):
            output.print(f"[bold]Next capture {number}:[/] {escape(str(suggestion))}")


def _print_poses(output: Console, calibration: Calibration) -> None:
    """Prints positions and rotations with their standard deviations and verdicts, a line for each sensor."""
    axes, turns = (slice(2), slice(2, 3)) if calibration.planar else (slice(3), slice(3))
    timed = any(sensor.clock_offset is not None for sensor in calibration.sensors)
    positions, rotations = ("x, m", "y, m", "z, m")[axes], ("roll, °", "pitch, °", "yaw, °")[turns]
    rows = []
    for sensor in calibration.sensors:
        T = sensor.T_root_sensor
        rows.append((
            escape(sensor.name) + (" (upside-down)" if calibration.planar and T[2, 2] < 0 else ""),
            *(_format_fixed(v, 3) for v in T[:3, 3][axes]),
            *(_format_fixed(v, 2) for v in np.degrees(roll_pitch_yaw(T[:3, :3]))[turns]),
            *_deviations(sensor),
            *([_clock(sensor)] if timed else []),
            _GRADES[sensor.verdict.grade] if sensor.parent is not None else "",
        ))  # fmt: skip
    clocks = ("clock ± σ, ms",) if timed else ()
    output.print(make_table(["sensor"], (*positions, *rotations, "σ, mm", "σ, °", *clocks, ""), rows))


def _print_base(output: Console, root: str, base: BaseFrame) -> None:
    """Prints where the root is on the vehicle, ± σ along and about the axes of the vehicle, and the verdict."""
    output.print(
        escape(f"{root} in {base.frame}, on the floor below the {base.axle} axle (σ: by axis)"), style="bold"
    )
    from calgraph.report.formatting import format_base  # as in _deviations

    for axis, value in format_base(base).items():
        output.print(f"  {axis:5} {value}")
    if base.verdict.grade != "good":
        verdict = f"{base.frame} is {base.verdict.grade}: {base.verdict.reason}"
        output.print(f"{_GRADES[base.verdict.grade]} {escape(verdict)}")


def _print_verdicts(output: Console, calibration: Calibration) -> None:
    """Prints why sensors are not good: those with the same verdict in one line, and once what several share."""
    by_verdict: dict[Verdict, list[str]] = {}
    for sensor in calibration.sensors:
        if sensor.verdict.grade != "good" or sensor.verdict.reason:
            by_verdict.setdefault(sensor.verdict, []).append(sensor.name)
    names = {verdict: ", ".join(of_verdict) for verdict, of_verdict in by_verdict.items()}
    reasons, shared = share_clauses({names[verdict]: verdict.reason for verdict in names if verdict.reason})
    for verdict, of_verdict in by_verdict.items():
        state = f"{names[verdict]} {'is' if len(of_verdict) == 1 else 'are'} {verdict.grade}"
        reason = f": {reasons[names[verdict]]}" if verdict.reason else ""
        output.print(f"{_GRADES[verdict.grade]} {escape(state + reason)}")
    for mark, text in shared.items():
        output.print(escape(f"{mark} {text}"))


def print_provenance(provenance: Provenance) -> None:
    """Prints how a calibration was computed, one line each."""
    output = console()
    output.print(escape(f"Computed by calgraph {provenance.version} at {provenance.date}: {provenance.command}"))
    for one in provenance.inputs:
        output.print(escape(f"{one.kind or 'from'} {one.path} (SHA-256 {one.sha256[:12]}…)"))
    if provenance.start is not None and provenance.duration is not None:
        start = datetime.fromtimestamp(provenance.start, UTC).isoformat(timespec="seconds")
        output.print(f"recorded {start}, {provenance.duration:.1f} s, {provenance.messages} messages")
    if provenance.cached:
        output.print(escape(f"detections of {', '.join(provenance.cached)} were taken from the cache"))


def print_remarks(calibration: Calibration) -> None:
    """Prints the remarks on the whole result that no verdict contains, one line each."""
    for remark in calibration.further_remarks:
        console().print(f"[yellow]![/] {escape(remark)}")


def print_remedies(calibration: Calibration, stated: str = "") -> None:
    """Prints what makes sensors more certain, one line for each action, but for what another line has stated."""
    for action, remedies in calibration.evidence.remedies_by_action.items():
        effects = [one.effect for one in remedies if str(one) not in stated]
        if (more := len(effects) - _MAX_EFFECTS) > 0:
            effects[_MAX_EFFECTS:] = [f"and {more} other sensor{'s' * (more > 1)}"]
        if effects:
            console().print(f"[bold]What helps:[/] {escape(f'{action}: ' + '; '.join(effects))}")


def _print_cross_validation(output: Console, calibration: Calibration) -> None:
    """Prints the residuals of each sensor, RMS, and its errors on held-out captures."""
    output.print("[bold]Residuals, fitted and on held-out captures[/] (ratio = observed / expected)")
    fit = calibration.evidence.fit
    rows = (
        (escape(name), str(one.captures), fit[name].formatted if name in fit else "", *one.formatted,
         f"{one.ratio:.2f}")
        for name, one in calibration.evidence.cross_validation.items()
    )  # fmt: skip
    numbers = ("predicted", "fitted", "held out", "median", "along beam", "tilt", "ratio")
    output.print(make_table(["sensor"], numbers, rows))


def _print_fit(output: Console, calibration: Calibration) -> None:
    """Prints the residuals of each sensor, RMS."""
    output.print("[bold]Residuals[/] (of single measurements; poses are averages of all)")
    rows = ((escape(name), str(one.count), one.formatted) for name, one in calibration.evidence.fit.items())
    output.print(make_table(["sensor"], ("measurements", "RMS"), rows))


def _notable_parameters(calibration: Calibration) -> Iterator[EstimatedParameter]:
    """The systematic parameters that are more than one prior standard deviation off their stated values."""
    return (one for one in calibration.systematic if abs(one.deviation) > 1)


def _print_intrinsics(output: Console, calibration: Calibration, name: str, intrinsics: Intrinsics) -> None:
    """Prints the intrinsics of one camera that were estimated from the recording, with standard deviations."""
    output.print(
        f"[bold]Intrinsics of {escape(name)}[/], estimated from {intrinsics.estimated_from_views} views: "
        f"{intrinsics.model}, {intrinsics.width} x {intrinsics.height} pixels"
    )
    rows = ((one.quantity, *one.formatted[2:]) for one in calibration.systematic if one.of == name)
    output.print(make_table(["parameter"], ("estimate", "σ", "unit"), rows))


def _print_systematic(output: Console, calibration: Calibration) -> None:
    """Prints the systematic parameters that are off their stated values."""
    output.print("[bold]Systematic parameters more than one prior σ off their stated values[/]")
    numbers = ("stated", "prior σ", "estimate", "σ", "unit", "deviation")
    rows = (
        (escape(one.of), one.quantity, *one.formatted, f"{one.deviation:+.1f} prior σ")
        for one in _notable_parameters(calibration)
    )
    output.print(make_table(["of", "parameter"], numbers, rows))


def print_errors(calibration: Calibration, T_root_sensor: Mapping[str, Array]) -> None:
    """Prints how far each sensor's pose is from the ground truth, with its standard deviation.

    Args:
        calibration: the result.
        T_root_sensor: true poses (4, 4) by sensor.
    """
    output = console()
    output.print("[bold]Errors against the ground truth[/] (σ: along and about its worst axis)")
    rows = []
    for sensor in calibration.sensors:
        if sensor.parent is not None:
            error = se3.difference(sensor.T_root_sensor, T_root_sensor[sensor.name])
            mm, degrees = 1000 * np.linalg.norm(error[:3]), np.degrees(np.linalg.norm(error[3:]))
            sigma_mm, sigma_degrees = _deviations(sensor)
            rows.append((escape(sensor.name), f"{mm:.1f}", sigma_mm, f"{degrees:.3f}", sigma_degrees))
    output.print(make_table(["sensor"], ("error, mm", "σ, mm", "error, °", "σ, °"), rows))


# Sources of smaller shares hardly change σ: they are added up, as are those beyond the largest ones.
_MIN_PRINTED_SHARE, _MAX_PRINTED_SOURCES = 0.1, 4


def print_budget(calibration: Calibration) -> None:
    """Prints the largest sources of each sensor's errors along and about its worst axis, if they are known."""
    if (budget := calibration.budget) is None:
        return
    axes = [
        (sensor, k, first + int(np.argmax(sensor.axis_stddev[first : first + 3])))
        for k, sensor in enumerate(calibration.sensors)
        if sensor.parent is not None
        for first in (0, 3)
    ]
    _print_sources("Where the uncertainty comes from", budget, axes)


def print_pair_budget(budget: ErrorBudget, a: str, b: SensorPose) -> None:
    """Prints the largest sources of the errors of the pose of a sensor relative to another one, by axis.

    Args:
        budget: of this pose alone.
        a: the sensor in whose frame it is.
        b: the sensor.
    """
    axes = [(b, 0, axis) for axis in range(6) if budget.largest(0, axis)]
    _print_sources(f"Where the uncertainty of {b.name} in the frame of {a} comes from", budget, axes)


def _print_sources(title: str, budget: ErrorBudget, axes: Iterable[tuple[SensorPose, int, int]]) -> None:
    """Prints the sources of axes, each given by the sensor, its index in the budget, and the index of the axis."""
    from calgraph.report.formatting import format_angle, format_count, format_length  # as in _deviations

    output = console()
    output.print(f"[bold]{escape(title)}[/] (shares of the variance)")
    table: list[tuple[str, ...]] = []
    for sensor, k, axis in axes:
        format_stddev = format_length if axis < 3 else format_angle
        sources = budget.largest(k, axis)
        groups: defaultdict[str, list[float]] = defaultdict(list)
        for source, _, share in sources:
            # What is small of one sensor may be large of all together, as their range scales.
            groups[str(source) if share >= _MIN_PRINTED_SHARE else source.kind].append(share)
        largest = sorted(groups.items(), key=lambda one: -sum(one[1]))[:_MAX_PRINTED_SOURCES]
        shown = [(name, shares) for name, shares in largest if sum(shares) >= _MIN_PRINTED_SHARE]
        rows = [(f"{len(shares)} × {name}" if len(shares) > 1 else name, sum(shares)) for name, shares in shown]
        if others := len(sources) - sum(len(shares) for _, shares in shown):
            rows.append((format_count(others, "other"), 1 - sum(share for _, share in rows)))
        sigma = float(np.linalg.norm([stddev for _, stddev, _ in sources]))
        head = escape(sensor.name), KINDS[sensor.kind].axes[axis], format_stddev(sigma)
        for name, share in rows:
            table.append((*head, escape(name), format_stddev(sigma * share**0.5), f"{100 * share:.0f} %"))
            head = "", "", ""
    output.print(make_table(["sensor", "axis", "σ", "from"], ("σ", "share"), table))


def print_output_path(out: Path) -> None:
    """Prints where the results are."""
    console().print(f"Results are in {escape(str(out))}; open {escape(str(out / 'report.html'))}")


def _deviations(sensor: SensorPose) -> tuple[str, str]:
    """Standard deviations along and about the worst axis, mm and degrees; the root has none."""
    if sensor.parent is None:
        return "root", ""
    from calgraph.report.formatting import (
        format_significant,
    )  # brings plots along, which --help should not wait for

    position, rotation = sensor.worst_stddev
    return format_significant(1000 * position), format_significant(float(np.degrees(rotation)))


def _clock(sensor: SensorPose) -> str:
    """Clock offset and its standard deviation, ms; nothing where it was not estimated."""
    if sensor.clock_offset is None:
        return ""
    stddev = sensor.clock_offset_stddev
    deviation = "" if stddev is None else f" ±{_format_fixed(1e3 * stddev, 1)}"
    return f"{_format_fixed(1e3 * sensor.clock_offset, 1)}{deviation}"


def _format_fixed(value: float, digits: int) -> str:
    """A number with ``digits`` decimals; 0 for what rounds to -0."""
    return f"{round(value, digits) + 0.0:.{digits}f}" if np.isfinite(value) else "∞"
