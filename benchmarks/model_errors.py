"""The verdict of a calibration where the world differs from rig.yaml: one thing at a time is made wrong.

python benchmarks/model_errors.py --jobs 3                       # all kinds, rigs and seeds; 102 right runs
python benchmarks/model_errors.py --kinds print_scale tag_size   # some kinds, and right runs of the same seeds
python benchmarks/model_errors.py --kinds range_bias --sizes 30  # in the units of the table
python benchmarks/model_errors.py --csv runs.csv                 # a row for each run; the next one resumes it
python benchmarks/model_errors.py --draw --runs 50               # all systematic errors drawn from their priors
python benchmarks/model_errors.py --stated 0.5                   # rig.yaml states half of the default uncertainty

A pose is *confidently wrong* if its verdict is good and it is off by more than 5 of its standard deviations along
or about an axis, by more than 20 mm, or by more than 1 degree. A run counts as confidently wrong if one of its
sensors is, as good if all are, as remarked if the result has a remark, as failed if there is no result. NEES is
per degree of freedom; ``/right`` is the worst position error over that of the right run with the same seed.
Detections are ideal but for the errors, so that a run takes a fraction of a second; rigs and errors are those of
model_error_rigs.py and model_error_kinds.py. After a bump the true pose is that at the end.
"""

import argparse
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.linalg import LinAlgError
from scipy.stats import chi2

from calgraph.config import Rig
from calgraph.errors import CalgraphError
from calgraph.result import SensorPose
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.simulation import GroundTruth, World
from ideal_detections import simulate_detections
from model_error_draws import draw_errors, scale_uncertainty
from model_error_kinds import KINDS, MODELLED, Wrong, cases, wrong_world
from model_error_rigs import SCENARIOS, rig_world
from worlds import (
    NAN,
    Layout,
    PoseError,
    find_errors,
    grouped,
    make_parser,
    mean,
    median,
    rms,
    run_worlds,
    share,
    worst,
)

RIGHT, DRAWN = "right", "drawn"
"""Kinds besides those of model_error_kinds.py."""
MAX_SIGMAS, MAX_METRES, MAX_DEGREES = 5.0, 0.020, 1.0
"""A good pose that is off by more is confidently wrong."""
RIGS = "five", "chain", "pair"
DRAWN_CAPTURES = 8, 16, 40


@dataclass(frozen=True)
class Outcome:
    """Of one run."""

    rig: str
    kind: str
    """``right``, or of the error."""
    size: float
    seed: int
    placed: int = 0
    """Sensors with a pose besides the root."""
    good: bool = False
    """Whether all sensors have a pose, and are good."""
    remarks: int = 0
    confidently_wrong: bool = False
    crashed: bool = False
    """Whether another error than one of calgraph's ended the run."""
    millimetres: float = NAN
    """Worst error of a sensor; NaN if there is none."""
    degrees: float = NAN
    sigmas: float = NAN
    """Worst along or about an axis."""
    nees: float = NAN
    """Mean over sensors, per degree of freedom."""
    outside: float = NAN
    """Share of sensors beyond the 99 % ellipsoid of their covariance."""
    seconds: float = NAN
    text: str = ""
    """Remarks, verdicts that are not good, or why the run failed."""


def main() -> None:
    """Prints a table by rig, kind and size, and totals; or with drawn errors."""
    parser = make_parser(__doc__, jobs=3)
    parser.add_argument("--kinds", nargs="+", choices=[*KINDS, RIGHT], default=[*KINDS, RIGHT])
    parser.add_argument("--sizes", nargs="+", type=float, default=[], help="only these, in the units of the table")
    parser.add_argument("--rigs", nargs="+", choices=list(SCENARIOS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="of the wrong runs")
    parser.add_argument(
        "--right", type=int, default=34, help="right runs of each rig, if `right` is among the kinds"
    )
    parser.add_argument("--draw", action="store_true", help="all systematic errors drawn from their priors")
    parser.add_argument("--captures", nargs="+", type=int, default=list(DRAWN_CAPTURES), help="of drawn errors")
    parser.add_argument("--runs", type=int, default=20, help="of each rig with drawn errors")
    parser.add_argument(
        "--stated",
        type=float,
        default=1.0,
        help="uncertainty of systematic errors in rig.yaml over the default one",
    )
    arguments = parser.parse_args()
    arguments.rigs = arguments.rigs or RIGS
    calibrate = partial(run, stated=arguments.stated)
    if arguments.draw:
        work = [
            (rig, DRAWN, captures, seed)
            for rig in arguments.rigs
            for seed in range(arguments.runs)
            for captures in arguments.captures
        ]
        show_drawn(run_worlds(Outcome, calibrate, work, arguments, key=4))
    else:
        show(run_worlds(Outcome, calibrate, wrong_and_right(arguments), arguments, key=4))


def wrong_and_right(arguments: argparse.Namespace) -> list[tuple[str, str, float, int]]:
    """Rig, kind, size and seed of all runs. Runs in one world are neighbours: it is built once."""
    kinds = tuple(kind for kind in arguments.kinds if kind != RIGHT)
    right = range(arguments.right) if RIGHT in arguments.kinds else ()
    work = []
    for rig in arguments.rigs:
        for seed in sorted({*arguments.seeds, *right}):
            work.append((rig, RIGHT, 0.0, seed))
            if seed in arguments.seeds:
                work += [(rig, kind, size, seed) for kind, size in cases(kinds, tuple(arguments.sizes))]
    return work


def run(rig: str, kind: str, size: float, seed: int, *, stated: float = 1.0) -> Outcome | None:
    """One run; None where the rig has no sensor that could be wrong so."""
    detected = detect(rig, kind, size, seed)
    if detected is None:
        return None
    description, captured, truth = detected
    return judge((rig, kind, size, seed), scale_uncertainty(description, stated), captured, truth)


def detect(rig: str, kind: str, size: float, seed: int) -> tuple[Rig, CaptureSet, GroundTruth] | None:
    """The detections of a world, and the ground truth; None where the rig has no sensor that could be wrong so.

    Args:
        rig: of :data:`model_error_rigs.SCENARIOS`.
        kind: of an error, or right, or drawn.
        size: of the error; of drawn ones the number of captures.
        seed: of everything that is drawn.
    """
    if kind == DRAWN:
        rng = np.random.default_rng((seed, 15))
        world = with_captures(rig_world(rig, seed), int(size), rng)
        return simulate_detections(world, seed, None, draw_errors(world, rng))
    wrong = Wrong() if kind == RIGHT else wrong_world(kind, size, rig, seed)
    if wrong is None:
        return None
    return simulate_detections(rig_world(rig, seed, wrong.scenario), seed, wrong.options, wrong.errors)


def with_captures(world: World, count: int, rng: np.random.Generator) -> World:
    """The same world with some of its holds, drawn at random."""
    holds = world.trajectory.holds
    chosen = np.sort(rng.permutation(len(holds))[:count])
    return replace(world, trajectory=replace(world.trajectory, holds=tuple(holds[i] for i in chosen)))


def judge(case: tuple[str, str, float, int], rig: Rig, captured: CaptureSet, truth: GroundTruth) -> Outcome:
    """Calibrates, and compares with the ground truth."""
    began = time.perf_counter()
    try:
        problem = build_problem_from_captures(rig, captured, RigOptions(), np.random.default_rng(case[3]))
        found = solve_problem(problem)
    except (CalgraphError, ArithmeticError, LinAlgError, LookupError, ValueError) as error:
        crashed, text = not isinstance(error, CalgraphError), f"{type(error).__name__}: {error}"
        return Outcome(*case, crashed=crashed, seconds=time.perf_counter() - began, text=text)
    seconds = time.perf_counter() - began
    sensors = [sensor for sensor in found.sensors if sensor.parent is not None]
    errors = list(find_errors(found, truth.T_root_sensor).values())
    verdicts = [f"{s.name} {s.verdict.grade}: {s.verdict.reason}" for s in sensors if s.verdict.grade != "good"]
    return Outcome(
        *case,
        placed=len(sensors),
        good=len(found.sensors) == len(rig.sensors) and not verdicts,
        remarks=len(found.evidence.remarks),
        confidently_wrong=any(is_confidently_wrong(*pair) for pair in zip(sensors, errors, strict=True)),
        millimetres=1000 * max((one.metres for one in errors), default=NAN),
        degrees=max((one.degrees for one in errors), default=NAN),
        sigmas=max((one.sigmas for one in errors), default=NAN),
        nees=mean([one.nees for one in errors]),
        outside=mean([6 * one.nees > chi2.ppf(0.99, 6) for one in errors]),
        seconds=seconds,
        text=" | ".join([*found.evidence.remarks, *verdicts]),
    )


def is_confidently_wrong(sensor: SensorPose, error: PoseError) -> bool:
    """Whether a pose is good, and off by much."""
    far = error.sigmas > MAX_SIGMAS or error.metres > MAX_METRES or error.degrees > MAX_DEGREES
    return sensor.verdict.grade == "good" and far


def show(outcomes: Sequence[Outcome]) -> None:
    """Prints a line for each rig, kind and size, and totals."""
    reference = {(o.rig, o.seed): o for o in outcomes if o.kind == RIGHT}
    table = Layout(
        "rig:6 error:18 size:>10 runs:4d good:4d weak:4d rem.:4d fail:4d conf:4d mm:7.2f max:7.1f deg:7.3f "
        "max:7.2f sigmas:7.1f NEES:8.2f /right:7.2f"
    )
    print(table.head)
    for (rig, kind, size), group in grouped(outcomes, lambda o: (o.rig, o.kind, o.size)):
        ratios = [o.millimetres / reference[o.rig, o.seed].millimetres for o in group]
        label = "" if kind == RIGHT else KINDS[kind].label(size)
        millimetres, degrees = [o.millimetres for o in group], [o.degrees for o in group]
        print(
            table.line(
                rig, kind, label, len(group), count(group, "good"), weak(group), remarked(group), failed(group),
                count(group, "confidently_wrong"), median(millimetres), worst(millimetres), median(degrees),
                worst(degrees), worst([o.sigmas for o in group]), mean([o.nees for o in group]), median(ratios),
            )
        )  # fmt: skip
    right, wrong = [o for o in outcomes if o.kind == RIGHT], [o for o in outcomes if o.kind != RIGHT]
    show_totals("wrong", wrong)
    for kind, group in grouped(wrong, lambda o: o.kind):
        if count(group, "confidently_wrong"):
            print(f"    {kind:18} {count(group, 'confidently_wrong'):3d} of {len(group)}")
    show_modelled([o for o in wrong if o.kind in MODELLED], reference)
    for o in outcomes:
        if o.crashed:
            print(f"crashed: {o.rig} {o.kind} {o.size:g} seed {o.seed}: {o.text}")
    show_totals("right", right)
    flagged = [o for o in right if not o.good or o.remarks]
    print(f"right runs weak, failed or remarked: {len(flagged)} of {len(right)} ({share(flagged, right)})")
    for text, group in grouped(flagged, lambda o: o.text):
        print(f"    {len(group)} x {text[:200]}")


def show_modelled(outcomes: Sequence[Outcome], reference: Mapping[tuple[str, int], Outcome]) -> None:
    """Prints RMS errors over those of the right runs, and NEES, of errors that are parameters of the model."""
    print(f"errors that the model has parameters for: {'RMS/right':>9} {'NEES':>8}  (worst size)")
    for kind, group in grouped(outcomes, lambda o: o.kind):
        ratios, nees = [], []
        for _, runs in grouped([o for o in group if o.placed], lambda o: o.size):
            right = [reference[o.rig, o.seed] for o in runs]
            ratios.append(rms([o.millimetres for o in runs]) / rms([o.millimetres for o in right]))
            nees.append(mean([o.nees for o in runs]))
        print(f"    {kind:36} {worst(ratios):10.2f} {worst(nees):8.2f}")


def show_totals(name: str, outcomes: Sequence[Outcome]) -> None:
    """Prints how many runs have which verdict."""
    confident = [o for o in outcomes if o.confidently_wrong]
    print(
        f"{name}: {len(outcomes)} runs, {count(outcomes, 'good')} good, {weak(outcomes)} weak, "
        f"{failed(outcomes)} failed, {remarked(outcomes)} remarked; {len(confident)} confidently wrong "
        f"({share(confident, outcomes)}), {sum(not o.remarks for o in confident)} of them without a remark; NEES "
        f"median {median([o.nees for o in outcomes]):.2f}; {mean([o.seconds for o in outcomes]):.2f} s a run"
    )


def show_drawn(outcomes: Sequence[Outcome]) -> None:
    """Prints the NEES by number of captures."""
    table = Layout(
        "rig:6 captures:8g runs:4d placed:6d NEES:6.2f median:6.2f >_99_%:7.1% mm:7.2f max:7.1f good:4d rem.:4d "
        "conf:4d"
    )
    print(table.head)
    pooled = [replace(o, rig="all") for o in outcomes]
    for (rig, _, captures), group in grouped([*outcomes, *pooled], lambda o: (o.rig, o.kind, o.size)):
        nees, millimetres = [o.nees for o in group], [o.millimetres for o in group]
        print(
            table.line(
                rig, captures, len(group), sum(o.placed for o in group), mean(nees), median(nees),
                mean([o.outside for o in group]), median(millimetres), worst(millimetres), count(group, "good"),
                remarked(group), count(group, "confidently_wrong"),
            )
        )  # fmt: skip


def count(outcomes: Iterable[Outcome], attribute: str) -> int:
    """How many outcomes have a flag."""
    return sum(getattr(o, attribute) for o in outcomes)


def failed(outcomes: Iterable[Outcome]) -> int:
    """How many runs placed no sensor."""
    return sum(not o.placed for o in outcomes)


def weak(outcomes: Iterable[Outcome]) -> int:
    """How many runs have a sensor that is not good."""
    return sum(o.placed > 0 and not o.good for o in outcomes)


def remarked(outcomes: Iterable[Outcome]) -> int:
    """How many runs have a remark."""
    return sum(o.remarks > 0 for o in outcomes)


if __name__ == "__main__":
    main()
