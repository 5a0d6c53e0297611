"""How near estimators come to the Cramér–Rao bound, and whether their covariances hold.

python benchmarks/efficiency.py --runs 200                     # one rig, noise drawn 200 times
python benchmarks/efficiency.py --runs 50 --scenarios 4        # four rigs, 50 times each
python benchmarks/efficiency.py --systematic drawn             # systematic errors drawn from the priors

The RMSE of an efficient estimator over the bound is 1 up to chance. With consistent covariances, so is the NEES
per degree of freedom. ``ideal`` is one Gauss–Newton step from the ground truth with the true noise: no estimator
is better, and its errors share the noise of the others'. ``pairwise`` is the start along the spanning tree.
A pose should be good where its bound is within the tolerance: the last line counts those of the bundle that are
not, or that a remark names. How long estimators take is in times.py.
"""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import get_args

import numpy as np
from scipy.stats import chi2

from calgraph.config import Rig
from calgraph.geometry import Array, se3
from calgraph.rig.bundle.board_observations import BoardObservation
from calgraph.rig.bundle.board_outlines import add_outlines
from calgraph.rig.bundle.bundle_setup import build_bundle, update_noise
from calgraph.rig.bundle.bundle_solver import linearize_bundle
from calgraph.rig.bundle.covariances import pose_covariance
from calgraph.rig.bundle.problem import Estimator, Problem, SolverOptions
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.simulation import GroundTruth, RigScenario, World, build_world
from calgraph.verdict.grades import grade_pose
from ideal_detections import IdealDetectorOptions, simulate_detections
from model_error_draws import draw_errors
from rig_errors import ModelErrors
from simulated_captures import poses_of
from worlds import Layout, grouped, make_parser, mean, rms, run_worlds

IDEAL = "ideal"
ESTIMATORS = IDEAL, "pairwise", *get_args(Estimator)
CONFIDENCE = 0.99
TABLE = Layout("sensor:14 estimator:12 lost:5d x:6.2f y:6.2f z:6.2f rx:6.2f ry:6.2f rz:6.2f all:6.2f NEES:6.2f")


@dataclass(frozen=True, eq=False)
class Row:
    """What one estimator made of one sensor in one recording; NaN where it found no pose."""

    captures: int
    systematic: str
    world: int
    run: int
    estimators: str
    """All that have it, separated by spaces."""
    estimator: str
    sensor: str
    relative: Array
    """(6,) errors over the bound along and about the root's axes,"""
    squared: float
    """and squared Mahalanobis distance by the bound,"""
    nees: float
    """and by the stated covariance, both per degree of freedom."""
    reachable: bool
    """Whether the bound is within the tolerance;"""
    good: bool
    """and whether the pose is good, without a remark."""


def main() -> None:
    """Prints ratios to the bound, and NEES."""
    parser = make_parser(__doc__, jobs=1)
    parser.add_argument("--runs", type=int, default=200, help="of each rig")
    parser.add_argument("--scenarios", type=int, default=1, help="rigs")
    parser.add_argument("--captures", type=int, default=48, help="a multiple of 24")
    parser.add_argument("--systematic", choices=("none", "drawn"), default="none", help="systematic errors")
    parser.add_argument("--estimators", nargs="+", choices=ESTIMATORS, default=list(ESTIMATORS))
    arguments = parser.parse_args()
    work = [
        (arguments.captures, arguments.systematic, world, run, " ".join(arguments.estimators))
        for world in range(arguments.scenarios)
        for run in range(arguments.runs)
    ]
    show(run_worlds(Row, measure, work, arguments, key=5))


@lru_cache(maxsize=1)
def build_stage(captures: int, world: int) -> tuple[World, Rig]:
    """The five-sensor rig with its board poses, and with the noise that its measurements have."""
    stage = build_world(RigScenario(samples=captures // 24), world, images=False)
    return stage, simulate_detections(stage, 0, IdealDetectorOptions())[0]


def measure(captures: int, systematic: str, world: int, run: int, estimators: str) -> list[Row]:
    """What estimators make of one recording; those of a world differ in their noise only."""
    stage, noise = build_stage(captures, world)
    rng = np.random.default_rng((world, run))
    errors = draw_errors(stage, rng) if systematic == "drawn" else ModelErrors()
    rig, captured, truth = simulate_detections(stage, run, IdealDetectorOptions(), errors)
    T_root_sensor = {rig.root: truth.T_root_sensor[rig.root], **truth.T_root_sensor}
    bounds, ideal = solve_at_truth(noise, captured, T_root_sensor, locate_boards(captured, truth))
    problem = build_problem_from_captures(rig, captured, RigOptions(), np.random.default_rng(run))
    rows = []
    for estimator in estimators.split():
        poses, covariances, good = (ideal, bounds, set()) if estimator == IDEAL else solve(problem, estimator)
        for sensor, bound in bounds.items():
            kind, T = rig.sensors[sensor].kind, truth.T_root_sensor[sensor]
            verdict = grade_pose(
                sensor, kind, T, bound, tolerance=rig.tolerance, settings=rig.settings.diagnostics.verdict
            )
            off = np.full(6, np.nan)
            if sensor in poses:
                off = se3.difference(poses[sensor], truth.T_root_sensor[sensor])
            squared, nees = (
                float(off @ np.linalg.solve(one, off)) / 6
                for one in (bound, covariances.get(sensor, np.eye(6) * np.nan))
            )
            relative = off / np.sqrt(np.diag(bound))
            judged = verdict.grade == "good", sensor in good
            rows.append(
                Row(
                    captures,
                    systematic,
                    world,
                    run,
                    estimators,
                    estimator,
                    sensor,
                    relative,
                    squared,
                    nees,
                    *judged,
                )
            )
    return rows


def solve(problem: Problem, estimator: str) -> tuple[Mapping[str, Array], Mapping[str, Array], Set[str]]:
    """``T_root_sensor`` by sensor; covariances (6, 6) where the estimator states them; and the good sensors.

    Good are those that no remark names, too; with a remark that names none of them, no sensor is.
    """
    if estimator == "pairwise":
        return problem.tree.T_root_sensor, {}, set()
    solver = SolverOptions.model_validate({**problem.solver.model_dump(), "estimator": estimator, "folds": 0})
    calibration = solve_problem(replace(problem, solver=solver))
    remarks = calibration.evidence.remarks
    remarked = {s.name for s in calibration.sensors if any(s.name in remark for remark in remarks)}
    good = {s.name for s in calibration.sensors if s.verdict.grade == "good"} - remarked
    covariances = {sensor.name: sensor.covariance for sensor in calibration.sensors}
    return poses_of(calibration), covariances, good if remarked or not remarks else set()


def locate_boards(captured: CaptureSet, truth: GroundTruth) -> dict[int, Array]:
    """True poses (4, 4) of the board by capture."""
    starts = np.array([board.trigger for board in truth.boards])
    nearest = {hold.index: int(np.argmin(np.abs(starts - hold.start))) for hold in captured.holds}
    return {index: truth.boards[i].T_root_board for index, i in nearest.items()}


def solve_at_truth(
    rig: Rig, captured: CaptureSet, T_root_sensor: Mapping[str, Array], T_root_board: Mapping[int, Array]
) -> tuple[dict[str, Array], dict[str, Array]]:
    """By sensor but the root: the Cramér–Rao bound (6, 6) in the root's axes, and the ideal estimate (4, 4).

    Systematic errors have the priors of the rig, and edges of boards their least view bias in the bound (Van
    Trees, "Detection, estimation, and modulation theory", 1968, section 2.4.3), and none in the estimate.

    Args:
        rig: with the true noise of its sensors.
        captured: detections; of each sensor and capture the first.
        T_root_sensor: true poses (4, 4), the root first.
        T_root_board: true poses (4, 4) of the board by capture.
    """
    detected = {c: {n: 0 for n in T_root_sensor if c in captured.detections[n]} for c in T_root_board}
    boards = [BoardObservation(c, by) for c, by in detected.items() if by]
    bundle, start = build_bundle(rig, captured, boards, T_root_sensor)
    state = replace(start, T_root_board=np.array([T_root_board[board.capture] for board in boards]))
    bundle, laid = add_outlines(bundle, state, rig, captured.detections, boards, 0.0)
    state = replace(state, extra=laid.extra)
    least = np.array([bundle.least_bias_variance(k) for k in range(len(bundle.all_views))])
    exact = replace(update_noise(bundle, state), bias_variance=least)
    bound = pose_covariance(exact, state, linearize_bundle(exact, state))
    blocks = bound.reshape(len(bundle.sensors), 6, len(bundle.sensors), 6)
    unbiased = update_noise(replace(bundle, bias_variance=np.zeros_like(bundle.bias_variance)), state)
    H, g, _ = linearize_bundle(unbiased, state).eliminate_boards()
    steps = np.asarray(-np.linalg.solve(H, g)[: 6 * bundle.body_count].reshape(-1, 6))
    ideal = se3.retract(state.T_root_sensor[1:], steps)
    others = bundle.sensors[1:]
    return {n: blocks[i, :, i] for i, n in enumerate(others, 1)}, dict(zip(others, ideal, strict=True))


def show(rows: Sequence[Row]) -> None:
    """Prints a line for each sensor and estimator, and for all sensors of each."""
    runs = len(grouped(rows, lambda row: (row.world, row.run)))
    low, high = np.sqrt(np.array(chi2.interval(CONFIDENCE, runs)) / runs)
    print(f"RMSE over the Cramér–Rao bound (chance along one axis: {low:.2f} to {high:.2f}), and mean NEES")
    print(TABLE.head)
    by_sensor = grouped(rows, lambda row: (row.sensor, row.estimator))
    for label, group in [*by_sensor, *grouped(rows, lambda row: ("all", row.estimator))]:
        axes = [rms([row.relative[k] for row in group]) for k in range(6)]
        together = float(np.sqrt(mean([row.squared for row in group])))
        lost = sum(bool(np.isnan(row.squared)) for row in group)
        print(TABLE.line(*label, lost, *axes, together, mean([row.nees for row in group])))
    reachable = [row for row in rows if row.reachable and row.estimator == "bundle"]
    missed = len(reachable) - sum(row.good for row in reachable)
    print(f"{len(reachable)} poses whose bound is within the tolerance; {missed} of them weak or remarked")


if __name__ == "__main__":
    main()
