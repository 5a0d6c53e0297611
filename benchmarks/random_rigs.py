"""Whole pipelines on random rigs: simulated messages, detections, pairs, graph, joint solution, verdicts.

python benchmarks/random_rigs.py --seeds 10000 12000 --jobs 2 --csv rigs.csv   # table of docs/benchmarks.md
python benchmarks/random_rigs.py --seeds 17 18 --verbose                       # one rig, with its verdicts

Sensors, boards, rooms, captures, noise and errors are drawn by random_rig_draws.py, with ranges that users have;
random_rig_messages.py renders the messages. A pose is *confidently wrong*, as in model_errors.py, if its verdict
is good and it is off by more than 5 of its standard deviations along or about an axis, or by more than twice the
translation of its tolerance (20 mm at the default), or by 3.3 times its rotation (1 degree). *Outside* is a good
pose beyond the ellipsoid of its covariance that all good poses together leave with 5 % (Bonferroni).
A pose is *well posed* if good is expected of it: by geometry alone, and independent of any estimate, it is
connected to the root by pairs of sensors with enough varied common views (random_rig_views.py), in a rig without
error and with noise stated about right. A crash is any exception but those of calgraph.errors.
"""

import argparse
import csv
import logging
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import cv2
import numpy as np
from scipy.stats import chi2

from calgraph.errors import CalgraphError
from calgraph.geometry import se3
from calgraph.parallel.processes import parallel_map
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import calibrate_rig
from outcome_tables import NAN, grouped, mean, median, share, worst
from random_rig_draws import draw_rig, true_poses
from random_rig_messages import record
from random_rig_views import well_posed_sensors

MAX_SIGMAS, MAX_TRANSLATION, MAX_ROTATION = 5.0, 2.0, 1.0 / 0.3
"""Standard deviations, and multiples of the tolerance."""
TIMEOUT = 300
"""A rig that takes longer counts as crashed, s."""
FAMILY_LEVEL = 0.05
"""Probability that one of all good poses lies outside by chance."""
CLASSES = (
    "setup",
    "mode",
    "layout",
    "kinds",
    "board",
    "geometry",
    "captures",
    "room",
    "noise",
    "outliers",
    "error",
    "tolerance",
)


@dataclass(frozen=True)
class SensorOutcome:
    """Of one sensor besides the root."""

    seed: int
    sensor: str
    labels: str
    """Of the rig, ``key=value`` separated by ``|``."""
    grade: str
    """good, weak, unobservable; ``no pose`` where nothing connects it; failed, or crashed."""
    well_posed: bool
    tolerance: float = NAN
    """Of the translation, m."""
    millimetres: float = NAN
    degrees: float = NAN
    sigmas: float = NAN
    """Worst along or about an axis."""
    nees: float = NAN
    """Per degree of freedom."""
    within: bool = True
    """Whether the error is within the tolerance along and about each axis."""
    confidently_wrong: bool = False
    seconds: float = 0.0
    """CPU time of the rig, simulated and calibrated."""
    text: str = ""
    """Reason of the verdict, or the error."""


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs=2, type=int, default=[0, 100], help="first, and one past the last")
    parser.add_argument("--moving", action="store_true", help="boards that never rest, in synchronized frames")
    parser.add_argument("--unknown-lenses", type=float, default=0.0, help="share of cameras without intrinsics")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--csv", type=Path, help="file to write all sensors to")
    parser.add_argument("--read", nargs="+", type=Path, default=[], help="such files, instead of runs")
    parser.add_argument("--minutes", type=float, default=np.inf, help="start no further rigs after this time")
    parser.add_argument("--verbose", action="store_true", help="a line for each sensor")
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)
    if arguments.read:
        outcomes = [one for path in arguments.read for one in load(path)]
    else:
        outcomes = run_all(range(*arguments.seeds), arguments)
    if arguments.verbose:
        for o in outcomes:
            print(
                f"{o.seed:5d} {o.sensor:12} {o.grade:12} {o.millimetres:8.2f} mm {o.degrees:7.3f} deg "
                f"{o.sigmas:5.1f} sigmas {o.text}"
            )
    show(outcomes)


def run_all(seeds: Sequence[int], arguments: argparse.Namespace) -> list[SensorOutcome]:
    """Runs in blocks, and saves after each: an interrupted run keeps what it has."""
    began, outcomes = time.monotonic(), []
    block = 20 * arguments.jobs
    for first in range(0, len(seeds), block):
        if time.monotonic() - began > 60 * arguments.minutes:
            break
        rigs = [(seed, arguments.moving, arguments.unknown_lenses) for seed in seeds[first : first + block]]
        part = parallel_map(run, rigs, arguments.jobs)
        outcomes += [one for of_rig in part for one in of_rig]
        if arguments.csv:
            save(arguments.csv, outcomes)
        print(f"\r{min(first + block, len(seeds))} of {len(seeds)} rigs", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return outcomes


def run(seed: int, moving: bool = False, unknown_lenses: float = 0.0) -> list[SensorOutcome]:
    """Draws, records, calibrates and compares the rig of a seed; see :func:`draw_rig`."""
    cv2.setNumThreads(1)
    began = time.process_time()
    rig = draw_rig(seed, moving, unknown_lenses)
    recording = record(rig)
    others = [name for name in rig.stated.sensors if name != rig.stated.root]
    labels = "|".join(f"{key}={value}" for key, value in rig.labels.items())
    expected = well_posed_sensors(rig)
    signal.signal(signal.SIGALRM, _time_out)
    signal.alarm(TIMEOUT)
    try:
        with warnings.catch_warnings():
            # As in the tests: a warning of NumPy is an error.
            warnings.simplefilter("error")
            found = calibrate_rig(rig.stated, recording, RigOptions())
    except CalgraphError as error:
        return [
            SensorOutcome(
                seed,
                name,
                labels,
                "failed",
                name in expected,
                text=str(error),
                seconds=time.process_time() - began,
            )
            for name in others
        ]
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
        return [
            SensorOutcome(
                seed, name, labels, "crashed", name in expected, text=text, seconds=time.process_time() - began
            )
            for name in others
        ]
    finally:
        signal.alarm(0)
    seconds, true, tolerance = time.process_time() - began, true_poses(rig), rig.stated.tolerance
    outcomes = []
    for name in others:
        sensor = next((one for one in found.sensors if one.name == name), None)
        if sensor is None:
            reason = found.evidence.unconnected.get(name, "")
            outcomes.append(
                SensorOutcome(seed, name, labels, "no pose", name in expected, text=reason, seconds=seconds)
            )
            continue
        off = se3.difference(sensor.T_root_sensor, true[name])
        metres, degrees = float(np.linalg.norm(off[:3])), float(np.degrees(np.linalg.norm(off[3:])))
        sigmas = float(np.max(np.abs(off) / np.sqrt(np.diag(sensor.covariance))))
        good = sensor.verdict.grade == "good"
        outcomes.append(
            SensorOutcome(
                seed,
                name,
                labels,
                sensor.verdict.grade,
                name in expected,
                tolerance.translation,
                1000 * metres,
                degrees,
                sigmas,
                float(off @ np.linalg.solve(sensor.covariance, off) / 6),
                bool(np.all(np.abs(off) <= tolerance.limits)),
                good
                and (
                    sigmas > MAX_SIGMAS
                    or metres > MAX_TRANSLATION * tolerance.translation
                    or degrees > MAX_ROTATION * tolerance.rotation
                ),
                seconds,
                " | ".join([sensor.verdict.reason, *found.evidence.remarks]),
            )
        )
    return outcomes


def _time_out(_signal: int, _frame: FrameType | None) -> None:
    raise TimeoutError(f"not finished after {TIMEOUT} s")


def save(path: Path, outcomes: Sequence[SensorOutcome]) -> None:
    """Writes a row for each sensor."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [one.name for one in fields(SensorOutcome)])
        writer.writeheader()
        writer.writerows(asdict(o) for o in outcomes)


def load(path: Path) -> list[SensorOutcome]:
    """What :func:`save` wrote."""
    with path.open(newline="", encoding="utf-8") as file:
        return [SensorOutcome(**_parse(row)) for row in csv.DictReader(file)]


def _parse(row: Mapping[str, str]) -> dict[str, Any]:
    """The values of a row with their types."""
    texts, flags = {"sensor", "labels", "grade", "text"}, {"well_posed", "within", "confidently_wrong"}
    return {
        key: value
        if key in texts
        else value == "True"
        if key in flags
        else int(value)
        if key == "seed"
        else float(value)
        for key, value in row.items()
    }


def show(outcomes: Sequence[SensorOutcome]) -> None:
    """Prints counts, the table by class, and all that is confidently wrong, outside, or crashed."""
    rigs = grouped(outcomes, lambda o: o.seed)
    graded = [o for o in outcomes if np.isfinite(o.millimetres)]
    good = [o for o in graded if o.grade == "good"]
    limit = chi2.isf(FAMILY_LEVEL / max(len(good), 1), 6) / 6
    outside = [o for o in good if o.nees > limit]
    wrong = [o for o in good if o.confidently_wrong]
    seconds = [group[0].seconds for _, group in rigs]
    print(
        f"{len(rigs)} rigs, {len(outcomes)} sensors besides roots; "
        f"{mean(seconds):.2f} s of CPU a rig, at most {worst(seconds):.0f} s"
    )
    for grade, group in grouped(sorted(outcomes, key=lambda o: o.grade), lambda o: o.grade):
        print(f"    {grade:13} {len(group):5d} ({share(group, outcomes)})")
    print(f"confidently wrong: {len(wrong)} of {len(good)} good; beyond the ellipsoid of all: {len(outside)}")
    late = [o for o in good if not o.within]
    print(f"good, but out of tolerance along or about an axis: {len(late)} ({share(late, good)}; 5 % are allowed)")
    posed = [o for o in outcomes if o.well_posed]
    print(f"well posed: {len(posed)} sensors, good {share([o for o in posed if o.grade == 'good'], posed)}")
    whole = [group for _, group in rigs if all(o.well_posed for o in group)]
    all_good = [group for group in whole if all(o.grade == "good" for o in group)]
    print(f"well posed in all sensors: {len(whole)} rigs, all good {share(all_good, whole)}")
    print(
        f"\n{'class':28} {'rigs':>5} {'sens.':>6} {'good':>6} {'weak':>5} {'unob.':>5} {'none':>5} {'conf':>4} "
        f"{'NEES':>6} {'median':>6} {'>99 %':>6}"
    )
    row("all", outcomes)
    row("    good", good)
    row("    well posed", posed)
    for name in CLASSES:
        print(name)
        for label, of_label in sorted(grouped(outcomes, partial(_label, name=name))):
            row(f"    {label}", of_label)
    crashed = [o for o in outcomes if o.grade == "crashed"]
    for title, group in (("confidently wrong", wrong), ("outside", outside), ("crashed", crashed)):
        for o in group:
            print(
                f"{title}: seed {o.seed} {o.sensor} {o.millimetres:.1f} mm {o.degrees:.2f} deg "
                f"{o.sigmas:.1f} sigmas NEES {o.nees:.1f} [{o.labels}] {o.text}"
            )


def row(title: str, outcomes: Sequence[SensorOutcome]) -> None:
    """Prints a line of the table."""
    counts = {grade: sum(o.grade == grade for o in outcomes) for grade in ("good", "weak", "unobservable")}
    missing = len(outcomes) - sum(counts.values())
    # An unobservable pose has no meaningful covariance.
    nees = [o.nees for o in outcomes if o.grade in ("good", "weak")]
    wrong = sum(o.confidently_wrong for o in outcomes)
    beyond = [6 * one > chi2.ppf(0.99, 6) for one in nees]
    print(
        f"{title:28} {len({o.seed for o in outcomes}):5d} {len(outcomes):6d} {counts['good']:6d} "
        f"{counts['weak']:5d} {counts['unobservable']:5d} {missing:5d} {wrong:4d} "
        f"{mean(nees):6.2f} {median(nees):6.2f} {mean(beyond):6.1%}"
    )


def _label(outcome: SensorOutcome, name: str) -> str:
    value = dict(pair.split("=", 1) for pair in outcome.labels.split("|"))[name]
    return value.split(" ")[0] if name == "error" else value


if __name__ == "__main__":
    main()
