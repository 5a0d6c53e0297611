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

import signal
import time
import traceback
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import FrameType

import cv2
import numpy as np
from scipy.stats import chi2

from calgraph.config import Tolerance
from calgraph.errors import CalgraphError
from calgraph.geometry import Array
from calgraph.result import Calibration
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import calibrate_rig
from random_rig_draws import draw_rig, true_poses
from random_rig_messages import record
from random_rig_views import well_posed_sensors
from worlds import NAN, Layout, find_errors, grouped, make_parser, mean, median, run_worlds, share, worst

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
    parser = make_parser(__doc__, jobs=2)
    parser.add_argument("--seeds", nargs=2, type=int, default=[0, 100], help="first, and one past the last")
    parser.add_argument("--moving", action="store_true", help="boards that never rest, in synchronized frames")
    parser.add_argument("--unknown-lenses", type=float, default=0.0, help="share of cameras without intrinsics")
    parser.add_argument("--verbose", action="store_true", help="a line for each sensor")
    arguments = parser.parse_args()
    work = [(seed, arguments.moving, arguments.unknown_lenses) for seed in range(*arguments.seeds)]
    outcomes = run_worlds(SensorOutcome, run, work, arguments, key=1)
    if arguments.verbose:
        for o in outcomes:
            print(
                f"{o.seed:5d} {o.sensor:12} {o.grade:12} {o.millimetres:8.2f} mm {o.degrees:7.3f} deg "
                f"{o.sigmas:5.1f} sigmas {o.text}"
            )
    show(outcomes)


def run(seed: int, moving: bool = False, unknown_lenses: float = 0.0) -> list[SensorOutcome]:
    """Draws, records, calibrates and compares the rig of a seed; see :func:`draw_rig`."""
    cv2.setNumThreads(1)
    began = time.process_time()
    rig = draw_rig(seed, moving, unknown_lenses)
    recording = record(rig)
    labels = "|".join(f"{key}={value}" for key, value in rig.labels.items())
    expected = well_posed_sensors(rig)
    unknown = [
        SensorOutcome(seed, name, labels, "no pose", name in expected)
        for name in rig.stated.sensors
        if name != rig.stated.root
    ]
    signal.signal(signal.SIGALRM, _time_out)
    signal.alarm(TIMEOUT)
    try:
        with warnings.catch_warnings():
            # As in the tests: a warning of NumPy is an error.
            warnings.simplefilter("error")
            found = calibrate_rig(rig.stated, recording, RigOptions())
    except CalgraphError as error:
        seconds = time.process_time() - began
        return [replace(one, grade="failed", text=str(error), seconds=seconds) for one in unknown]
    except Exception as error:
        where, seconds = traceback.extract_tb(error.__traceback__)[-1], time.process_time() - began
        text = f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
        return [replace(one, grade="crashed", text=text, seconds=seconds) for one in unknown]
    finally:
        signal.alarm(0)
    seconds, true = time.process_time() - began, true_poses(rig)
    return [judge(replace(one, seconds=seconds), found, true, rig.stated.tolerance) for one in unknown]


def judge(
    outcome: SensorOutcome, found: Calibration, true: Mapping[str, Array], tolerance: Tolerance
) -> SensorOutcome:
    """The outcome of a sensor, with its verdict and errors if it has a pose."""
    sensor = next((one for one in found.sensors if one.name == outcome.sensor), None)
    if sensor is None or sensor.name == found.root:  # in place of the stated root
        return replace(outcome, text=found.evidence.unconnected.get(outcome.sensor, ""))
    error = find_errors(found, true)[sensor.name]
    far = (
        error.sigmas > MAX_SIGMAS
        or error.metres > MAX_TRANSLATION * tolerance.translation
        or error.degrees > MAX_ROTATION * tolerance.rotation
    )
    return replace(
        outcome,
        grade=sensor.verdict.grade,
        tolerance=tolerance.translation,
        millimetres=1000 * error.metres,
        degrees=error.degrees,
        sigmas=error.sigmas,
        nees=error.nees,
        within=bool(np.all(np.abs(error.axes) <= tolerance.limits)),
        confidently_wrong=sensor.verdict.grade == "good" and far,
        text=" | ".join([sensor.verdict.reason, *found.evidence.remarks]),
    )


def _time_out(_signal: int, _frame: FrameType | None) -> None:
    raise TimeoutError(f"not finished after {TIMEOUT} s")


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
    print(f"\n{TABLE.head}")
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


TABLE = Layout(
    "class:28 rigs:5d sens.:6d good:6d weak:5d unob.:5d none:5d conf:4d NEES:6.2f median:6.2f >99_%:6.1%"
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
        TABLE.line(
            title, len({o.seed for o in outcomes}), len(outcomes), *counts.values(), missing, wrong, mean(nees),
            median(nees), mean(beyond),
        )
    )  # fmt: skip


def _label(outcome: SensorOutcome, name: str) -> str:
    value = dict(pair.split("=", 1) for pair in outcome.labels.split("|"))[name]
    return value.split(" ")[0] if name == "error" else value


if __name__ == "__main__":
    main()
