"""CPU seconds that the joint solution of a rig takes, by captures and sensors, and against scipy's least squares.

OMP_NUM_THREADS=1 python benchmarks/solve_times.py                                     # five sensors
OMP_NUM_THREADS=1 python benchmarks/solve_times.py --sensors 5 10 20 --captures 120 504 1008
OMP_NUM_THREADS=1 python benchmarks/solve_times.py --captures 120 --oracle             # against scipy

Detections are simulated: clean, and with the noise that rig.yaml states. ``pairs`` is what comes before: all
pairs, and the tree. ``bundle`` is the whole joint solution from there, rounds of measuring the noise included. The
oracle starts where the bundle starts, with the same residuals, noise and robust cost, and stops when it is at the
same cost; there ``once`` is a single solution of the bundle at that noise.
"""

import argparse
import logging
import os
import time
from collections.abc import Callable
from dataclasses import replace
from statistics import median
from typing import TypeVar

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from calgraph.boards.detections import BoardCorners
from calgraph.graph.pairwise_estimate import select_matches
from calgraph.rig.bundle.board_observations import group_detections
from calgraph.rig.bundle.bundle_setup import build_bundle
from calgraph.rig.bundle.bundle_solver import minimize_bundle
from calgraph.rig.bundle.estimate import solve_bundle
from calgraph.rig.bundle.problem import Problem
from calgraph.rig.bundle.solution import RigSolution
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.options import RigOptions
from calgraph.rig.pairs.board_pair import select_successful
from calgraph.rig.pipeline import build_problem_from_captures
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    build_world,
    simulate_detections,
)
from sparse_problem import SparseProblem

# By number of sensors: cameras, 2-D scanners, spinning ones, LiDARs with rings.
RIGS = {5: (1, 3, 1, 0), 10: (3, 4, 2, 1), 20: (6, 8, 4, 2)}
Result = TypeVar("Result")
SAME_COST = 1e-6
"""Relative difference of costs that counts as none."""


def main() -> None:
    """Prints a line for each size of rig and number of captures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=int, nargs="+", default=[48, 120, 504, 1008, 5040])
    parser.add_argument("--sensors", type=int, nargs="+", choices=RIGS, default=[5])
    parser.add_argument("--repeat", type=int, default=3, help="the median counts")
    parser.add_argument("--oracle", action="store_true", help="compare with scipy.optimize.least_squares")
    arguments = parser.parse_args()
    if os.environ.get("OMP_NUM_THREADS") != "1":
        raise SystemExit("set OMP_NUM_THREADS=1: this measures one core")
    logging.disable(logging.WARNING)
    oracle = f"{'once':>8}{'scipy':>9}{'ratio':>7}{'cost':>11}" if arguments.oracle else ""
    print(f"{'sensors':>7}{'captures':>9}{'numbers':>10}{'pairs s':>9}{'bundle s':>9}{'ms each':>8}{oracle}")
    for sensors in arguments.sensors:
        for captures in arguments.captures:
            show(sensors, captures, arguments.repeat, arguments.oracle)


def show(sensors: int, captures: int, repeat: int, oracle: bool) -> None:
    """Prints one line."""
    rig, captured, _ = simulate_detections(build_world(scenario_of(sensors, captures), 0, images=False), 0)
    # Nothing is to be selected among clean detections, and the hypergraph's time is not this one's.
    before, problem = timed(
        lambda: build_problem_from_captures(rig, captured, RigOptions(keep="none"), np.random.default_rng(0)), 1
    )
    seconds, _ = timed(lambda: joint_solution(problem), repeat)
    line = f"{len(rig.sensors):7d}{len(captured.holds):9d}{numbers(captured):10d}{before:9.2f}{seconds:9.3f}"
    line += f"{1000 * seconds / len(captured.holds):8.2f}"
    print(line + (compared(problem, repeat) if oracle else ""), flush=True)


def scenario_of(sensors: int, captures: int) -> RigScenario:
    """A rig with numbers of sensors and captures, the latter a multiple of 24."""
    samples, rest = divmod(captures, 24)
    if rest or not samples:
        raise SystemExit(f"--captures: must be multiples of 24, got {captures}")
    cameras, lasers, spinning, multibeams = RIGS[sensors]
    return RigScenario(
        samples=samples,
        camera=CameraOptions(count=cameras),
        laser=LaserOptions(count=lasers),
        spinning=SpinningOptions(count=spinning),
        multibeam=MultibeamOptions(count=multibeams),
    )


def numbers(captured: CaptureSet) -> int:
    """How many numbers the detections measure."""
    found = [d for seen in captured.detections.values() for (d,) in seen.values()]
    return sum(2 * len(d.pixels) if isinstance(d, BoardCorners) else len(d.ranges) for d in found)


def joint_solution(problem: Problem) -> RigSolution:
    """The bundle, from pairs to covariances."""
    estimates, start = select_successful(problem.pairs), problem.tree.T_root_sensor
    return solve_bundle(problem.rig, problem.captures, estimates, start, keep=problem.solver.keep)


def compared(problem: Problem, repeat: int) -> str:
    """One solution of the bundle beside scipy's of the same problem: seconds, their ratio, difference in cost."""
    keep = problem.solver.keep
    boards = group_detections([(pair, select_matches(pair, keep)) for pair in select_successful(problem.pairs)])
    bundle, start = build_bundle(problem.rig, problem.captures, boards, problem.tree.T_root_sensor)
    bundle = replace(bundle, bias_variance=np.zeros_like(bundle.bias_variance))
    ours, solved = timed(lambda: minimize_bundle(bundle, start), repeat)
    scipys, cost = timed(lambda: scipy_cost(SparseProblem(bundle, start), solved.equations.cost), 1)
    return f"{ours:8.3f}{scipys:9.2f}{scipys / ours:7.1f}{cost / solved.equations.cost - 1:11.1e}"


def scipy_cost(problem: SparseProblem, goal: float) -> float:
    """The cost at which scipy's trust region stops: as soon as it is at the goal, or when it gives up."""

    def at_goal(intermediate_result: OptimizeResult) -> None:
        if intermediate_result.cost <= goal * (1 + SAME_COST):
            raise StopIteration

    found = least_squares(
        problem.residuals,
        np.zeros(problem.unknowns),
        problem.jacobian,
        x_scale="jac",
        ftol=1e-12,
        xtol=1e-12,
        gtol=1e-12,
        max_nfev=200,
        callback=at_goal,
    )
    return float(found.cost)


def timed(work: Callable[[], Result], repeat: int) -> tuple[float, Result]:
    """Median CPU seconds of some work, and what comes of it."""
    seconds, results = [], []
    for _ in range(repeat):
        began = time.process_time()
        results.append(work())
        seconds.append(time.process_time() - began)
    return median(seconds), results[-1]


if __name__ == "__main__":
    main()
