"""CPU seconds that the joint solution of a rig takes, by captures and sensors.

OMP_NUM_THREADS=1 python benchmarks/solve_times.py                                     # five sensors
OMP_NUM_THREADS=1 python benchmarks/solve_times.py --sensors 5 10 20 --captures 120 504 1008

Detections are simulated: clean, and with the noise that rig.yaml states. ``pairs`` is what comes before: all
pairs, and the tree. ``bundle`` is the whole joint solution from there, rounds of measuring the noise included.
"""

import logging
import os
import time
from collections.abc import Callable
from statistics import median
from typing import TypeVar

import numpy as np

from calgraph.boards.detections import BoardCorners
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
from worlds import make_parser

# By number of sensors: cameras, 2-D scanners, spinning ones, LiDARs with rings.
RIGS = {5: (1, 3, 1, 0), 10: (3, 4, 2, 1), 20: (6, 8, 4, 2)}
Result = TypeVar("Result")


def main() -> None:
    """Prints a line for each size of rig and number of captures."""
    parser = make_parser(__doc__)
    parser.add_argument("--captures", type=int, nargs="+", default=[48, 120, 504, 1008, 5040])
    parser.add_argument("--sensors", type=int, nargs="+", choices=RIGS, default=[5])
    parser.add_argument("--repeat", type=int, default=3, help="the median counts")
    arguments = parser.parse_args()
    if os.environ.get("OMP_NUM_THREADS") != "1":
        raise SystemExit("set OMP_NUM_THREADS=1: this measures one core")
    logging.disable(logging.WARNING)
    print(f"{'sensors':>7}{'captures':>9}{'numbers':>10}{'pairs s':>9}{'bundle s':>9}{'ms each':>8}")
    for sensors in arguments.sensors:
        for captures in arguments.captures:
            show(sensors, captures, arguments.repeat)


def show(sensors: int, captures: int, repeat: int) -> None:
    """Prints one line."""
    rig, captured, _ = simulate_detections(build_world(scenario_of(sensors, captures), 0, images=False), 0)
    # Nothing is to be selected among clean detections, and the hypergraph's time is not this one's.
    before, problem = timed(
        lambda: build_problem_from_captures(rig, captured, RigOptions(keep="none"), np.random.default_rng(0)), 1
    )
    seconds, _ = timed(lambda: joint_solution(problem), repeat)
    line = f"{len(rig.sensors):7d}{len(captured.holds):9d}{numbers(captured):10d}{before:9.2f}{seconds:9.3f}"
    print(f"{line}{1000 * seconds / len(captured.holds):8.2f}", flush=True)


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
