"""Sensors of recordings beside their ground truth: errors, NEES, verdicts, and what is confidently wrong.

A sensor is *confidently wrong* if its verdict is good and its pose is outside of the 99.9 % ellipsoid of its
covariance by more than 5 mm or 0.1 degrees, or more than 50 mm or 1 degree off, which is *gross*; ``out`` counts
those outside with any verdict. NEES is per degree of freedom, of the axes that were measured: of the pose, of its
translation, and of its rotation.
"""

import argparse
import os
import re
import resource
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.linalg import LinAlgError
from scipy.stats import beta, chi2

from calgraph.config.settings import VerdictSettings
from calgraph.errors import CalgraphError
from calgraph.geometry import Array, Index, se3
from calgraph.result import Calibration
from calgraph.verdict.comparison import SignificanceTest
from worlds import NAN, Layout, finite, grouped, make_parser, mean, median, share, worst

MAX_METRES, MAX_DEGREES = 0.005, 0.1
"""By which a good pose may be outside of its ellipsoid."""
FAR_METRES, FAR_DEGREES = 0.05, 1.0
"""By which a good pose may be off in any case."""
ELLIPSOID, CERTAINTY = 0.999, 0.95
"""Probability of the ellipsoid, and that of bounds on how many are confidently wrong."""
MOVES = (0.0, 0.005, 0.02, 0.05)
"""Sizes of moves that audits should find, m; 0 is none."""
DEGREES_PER_METRE = 10.0
"""By which sensors turn as well."""
DIRECTIONS = 32
"""Of each move."""
COLUMNS = (
    "kind:20 rig:14 worlds:6d all:4d good:4d weak:4d unob:4d none:4d mm:7.1f max:7.1f deg:6.3f max:6.3f "
    "clock:6.2f max_ms:6.1f NEES:6.2f trans:6.2f rot:6.2f out:4d conf:4d CPU_s:6.1f GB:5.2f"
)
"""Of the table; ``all`` counts worlds all of whose sensors have poses."""
ERRORS = (CalgraphError, ArithmeticError, LinAlgError, LookupError, ValueError)
"""Of a calibration that fails."""


@dataclass(frozen=True)
class Outcome:
    """Of one sensor of one world, the root left out."""

    kind: str
    rig: str
    seed: int
    duration: float
    """s."""
    sensor: str
    """Empty where the calibration failed, which counts as one sensor without a pose."""
    grade: str = "none"
    """Good, weak, unobservable; none where the sensor has no pose."""
    millimetres: float = NAN
    degrees: float = NAN
    clock_milliseconds: float = NAN
    """Error of the clock offset."""
    nees: float = NAN
    nees_translation: float = NAN
    nees_rotation: float = NAN
    stddev_millimetres: float = NAN
    """Largest standard deviation along an axis,"""
    stddev_degrees: float = NAN
    """and about one."""
    outside_millimetres: float = NAN
    """How far outside of the ellipsoid; 0 inside of it."""
    outside_degrees: float = NAN
    crashed: bool = False
    seconds: float = NAN
    """Processor time of the calibration."""
    simulated_seconds: float = NAN
    """And of the simulation."""
    gigabytes: float = NAN
    """Largest memory of the process during the calibration, with the messages."""
    false_alarm: float = NAN
    """Whether an audit finds that the sensor moved, which did not; of good poses,"""
    found_5: float = NAN
    found_20: float = NAN
    found_50: float = NAN
    """and the shares of moves by 5, 20 and 50 mm that it finds."""
    text: str = ""
    """Reason of the verdict or of its absence, and remarks."""

    @property
    def outside(self) -> bool:
        """Whether the pose is outside of its ellipsoid."""
        return self.outside_millimetres > 1000 * MAX_METRES or self.outside_degrees > MAX_DEGREES

    @property
    def gross(self) -> bool:
        """Whether the pose is far off."""
        return self.millimetres > 1000 * FAR_METRES or self.degrees > FAR_DEGREES

    @property
    def confidently_wrong(self) -> bool:
        """Whether the verdict is good and the pose is outside of its ellipsoid, or far off."""
        return self.grade == "good" and (self.outside or self.gross)


class Truth(NamedTuple):
    """What a result is compared with."""

    T_root_sensor: Mapping[str, Array]
    """(4, 4)."""
    clock_offsets: Mapping[str, float]
    """s."""


Judged = TypeVar("Judged", bound=Outcome)


def make_judging_parser(
    text: str | None, kinds: Sequence[str], default: Sequence[str], rigs: Sequence[str], tolerance: Sequence[float]
) -> argparse.ArgumentParser:
    """A command line that chooses worlds.

    Args:
        text: of the module.
        kinds: of worlds; ``wrong`` stands for some of them.
        default: kinds.
        rigs: names, of which the first is the default.
        tolerance: the default, m and degrees.
    """
    parser = make_parser(text, jobs=2)
    parser.add_argument("--kinds", nargs="+", choices=[*kinds, "wrong"], default=list(default))
    parser.add_argument("--rigs", nargs="+", choices=list(rigs), default=[rigs[0]])
    parser.add_argument("--seeds", nargs=2, type=int, default=[0, 8], help="first, and one past the last")
    parser.add_argument("--duration", type=float, default=60.0, help="s")
    parser.add_argument("--tolerance", nargs=2, type=float, default=list(tolerance), help="m, degrees")
    parser.add_argument("--verbose", action="store_true", help="a line for each sensor")
    return parser


def list_worlds(arguments: argparse.Namespace, wrong: Sequence[str], *more: object) -> list[tuple[Any, ...]]:
    """Kind, rig, seed and duration of each world that is asked for, and what all runs share."""
    kinds = dict.fromkeys(one for kind in arguments.kinds for one in (wrong if kind == "wrong" else [kind]))
    return [
        (kind, rig, seed, arguments.duration, *more)
        for kind in kinds
        for rig in arguments.rigs
        for seed in range(*arguments.seeds)
    ]


def measure(first: Judged, calibrate: Callable[[], Calibration]) -> tuple[Judged, Calibration | None]:
    """A row with time and memory of a calibration, and the result; without one, its row has the reason."""
    reset_peak()
    began = time.process_time()
    try:
        found = calibrate()
    except ERRORS as error:
        text, crashed = f"{type(error).__name__}: {error}", not isinstance(error, CalgraphError)
        return replace(first, crashed=crashed, seconds=time.process_time() - began, text=text), None
    return replace(first, seconds=time.process_time() - began, gigabytes=read_peak()), found


def judge(outcome: Judged, found: Calibration, truth: Truth) -> Judged:
    """Compares one sensor with the ground truth."""
    name, remarks = outcome.sensor, " | ".join(found.evidence.remarks)
    sensor = next((one for one in found.sensors if one.name == name), None)
    if sensor is None:
        return replace(outcome, text=f"{found.evidence.unconnected.get(name, '')} | {remarks}")
    error = se3.difference(sensor.T_root_sensor, truth.T_root_sensor[name])
    variances = np.diag(sensor.covariance)
    axes = np.flatnonzero(np.isfinite(variances) & (variances > 0))
    squared = _squared_distance(error, sensor.covariance, axes)
    limit = float(chi2.ppf(ELLIPSOID, max(len(axes), 1)))
    beyond = max(1 - np.sqrt(limit / squared), 0.0) if squared > 0 else 0.0
    known = np.zeros(6)
    known[axes] = error[axes]
    millimetres = 1000 * float(np.linalg.norm(known[:3]))
    degrees = float(np.degrees(np.linalg.norm(known[3:])))
    clock, (metres, radians) = sensor.clock_offset, sensor.worst_stddev
    translation, rotation = axes[axes < 3], axes[axes >= 3]
    good = sensor.verdict.grade == "good"
    audits = audit(error, sensor.covariance, axes, outcome.seed) if good else [NAN] * len(MOVES)
    return replace(
        outcome,
        grade=sensor.verdict.grade,
        millimetres=millimetres,
        degrees=degrees,
        clock_milliseconds=NAN if clock is None else 1000 * (clock - truth.clock_offsets[name]),
        nees=squared / max(len(axes), 1),
        nees_translation=_squared_distance(error, sensor.covariance, translation) / max(len(translation), 1),
        nees_rotation=_squared_distance(error, sensor.covariance, rotation) / max(len(rotation), 1),
        stddev_millimetres=1000 * metres,
        stddev_degrees=float(np.degrees(radians)),
        outside_millimetres=beyond * millimetres,
        outside_degrees=beyond * degrees,
        false_alarm=audits[0],
        found_5=audits[1],
        found_20=audits[2],
        found_50=audits[3],
        text=f"{sensor.verdict.reason} | {remarks}".strip(" |"),
    )


def audit(error: Array, covariance: Array, axes: Index, seed: int) -> list[float]:
    """Shares of the moves of each size that are significant beside the error (6,) of a pose."""
    rng = np.random.default_rng([seed, 7])
    limit = SignificanceTest.of(VerdictSettings().false_alarm_probability, len(axes)).max_chi2
    directions = np.zeros((DIRECTIONS, 6))
    directions[:, axes] = rng.normal(size=(DIRECTIONS, len(axes)))
    for block, unit in ((slice(0, 3), 1.0), (slice(3, 6), np.radians(DEGREES_PER_METRE))):
        directions[:, block] *= unit / np.linalg.norm(directions[:, block], axis=1, keepdims=True)
    return [
        float(np.mean([_squared_distance(error - size * one, covariance, axes) > limit for one in directions]))
        for size in MOVES
    ]


def _squared_distance(error: Array, covariance: Array, axes: Index) -> float:
    """Squared Mahalanobis distance along and about some axes."""
    part = error[axes]
    return float(part @ np.linalg.solve(covariance[np.ix_(axes, axes)], part)) if len(axes) else 0.0


def reset_peak() -> None:
    """Makes the largest memory of this process that of now, where the system has it."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def read_peak() -> float:
    """Largest memory of this process, GB."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 2**20
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def show_outcomes(
    outcomes: Sequence[Judged],
    verbose: bool,
    columns: str = "",
    figures: Callable[[Sequence[Sequence[Judged]]], tuple[float, ...]] = lambda _: (),
) -> None:
    """Prints tables of sensors, those that are confidently wrong, worlds without a result, and all reasons.

    Args:
        outcomes: of sensors.
        verbose: whether to print a line for each.
        columns: beside :data:`COLUMNS`.
        figures: of these columns, from the outcomes of each world.
    """
    print(f"{_processor()}, {os.cpu_count()} processors\n")
    for one in outcomes if verbose else ():
        print(
            f"{one.kind:20} {one.rig:14} {one.seed:4d} {one.sensor:12} {one.grade:12} {one.millimetres:8.2f} mm "
            f"(σ {one.stddev_millimetres:.2f}) {one.degrees:7.3f} deg (σ {one.stddev_degrees:.3f}) "
            f"{one.clock_milliseconds:7.2f} ms NEES {one.nees:.2f} {one.text[:160]}"
        )
    _show_table(outcomes, columns, figures)
    _show_trust(outcomes)
    _show_reasons(outcomes)


def _processor() -> str:
    """The name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return "unknown processor"
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")


def _show_table(
    outcomes: Sequence[Judged], columns: str, figures: Callable[[Sequence[Sequence[Judged]]], tuple[float, ...]]
) -> None:
    """Figures by kind and rig: medians and largest errors, means of NEES of poses that are observable."""
    table = Layout(f"{COLUMNS} {columns}")
    print(table.head)
    groups = grouped(outcomes, lambda one: (one.kind, one.rig))
    for label, group in [*groups, *([(("all", ""), list(outcomes))] if len(groups) > 1 else [])]:
        worlds = _by_world(group)
        grades = [sum(one.grade == grade for one in group) for grade in ("good", "weak", "unobservable", "none")]
        posed = [one for one in group if one.grade in ("good", "weak")]
        clocks = np.abs([one.clock_milliseconds for one in group])
        print(
            table.line(
                *label, len(worlds), sum(all(one.grade != "none" for one in some) for some in worlds), *grades,
                median([one.millimetres for one in group]), worst([one.millimetres for one in group]),
                median([one.degrees for one in group]), worst([one.degrees for one in group]),
                median(clocks), worst(clocks),
                mean([one.nees for one in posed]), mean([one.nees_translation for one in posed]),
                mean([one.nees_rotation for one in posed]),
                sum(one.outside for one in group), sum(one.confidently_wrong for one in group),
                mean([some[0].seconds for some in worlds]), worst([some[0].gigabytes for some in worlds]),
                *figures(worlds),
            )
        )  # fmt: skip


def _by_world(outcomes: Sequence[Judged]) -> list[list[Judged]]:
    return [group for _, group in grouped(outcomes, lambda one: (one.kind, one.rig, one.seed))]


def _show_trust(outcomes: Sequence[Outcome]) -> None:
    """The errors of good sensors, each that is confidently wrong, and how rare these are."""
    good = [one for one in outcomes if one.grade == "good"]
    confident, gross = [one for one in good if one.confidently_wrong], [one for one in good if one.gross]
    print(
        f"\nconfidently wrong: {len(confident)} of {len(good)} good sensors ({share(confident, good)}), "
        f"{len(gross)} gross"
    )
    if good:
        # Clopper and Pearson; 3 over their number where there is none.
        bound = float(beta.ppf(CERTAINTY, len(confident) + 1, max(len(good) - len(confident), 1)))
        print(
            f"good ones are at most {worst([one.millimetres for one in good]):.1f} mm and "
            f"{worst([one.degrees for one in good]):.3f} degrees off; with 95 %, less than {bound:.1%} are "
            "confidently wrong"
        )
    for one in confident:
        print(
            f"    {one.kind} {one.rig} seed {one.seed} {one.sensor}: {one.millimetres:.1f} mm, "
            f"{one.degrees:.3f} deg, NEES {one.nees:.1f}"
        )


def _show_reasons(outcomes: Sequence[Outcome]) -> None:
    """Worlds without a result, reasons and remarks by kind, and the time of simulations."""
    for one in outcomes:
        if not one.sensor:
            word = "crashed" if one.crashed else "failed"
            print(f"{word}: {one.kind} {one.rig} seed {one.seed}: {one.text[:200]}")
    print("\nreasons and remarks, by kind, without numbers:")
    texts = [(one.kind, clause.strip()) for one in outcomes for clause in one.text.split("|") if clause.strip()]
    for (kind, _), same in grouped(texts, lambda one: (one[0], re.sub(r"\d", "#", one[1]))):
        print(f"    {kind:20} {len(same):3d} x {same[0][1][:240]}")
    simulated = finite([some[0].simulated_seconds for some in _by_world(outcomes)])
    if len(simulated):
        print(f"\nsimulation: {simulated.mean():.1f} s of CPU a world, at most {simulated.max():.1f} s")
