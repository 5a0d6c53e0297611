"""Synchronized frames of a board that never rests: errors of poses against their standard deviations.

python benchmarks/moving_boards.py                          # 20 seeds, speeds 0.1 to 1 m/s, spreads 0 to 50 ms
python benchmarks/moving_boards.py --jitter 0.005 --readout 0.02 --seeds 20

Two cameras, a 16-ring LiDAR and a 2-D scanner measure the board in 40 sets of frames. Stamps of a set lie within
the spread; true times differ from stamps by the jitter, and cameras read their rows one after the other during the
readout. Neither is an input of the estimator. NEES: mean squared error over its variance (1 where covariances
hold). A sensor is confidently wrong where its verdict is good, it is off by more than its tolerance, and its NEES
is above 3.
"""

import logging
import time

import numpy as np

from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.simulation import (
    CameraOptions,
    IdealDetectorOptions,
    LaserOptions,
    MovingBoardOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    build_world,
    simulate_moving_detections,
)
from worlds import Layout, make_parser, measure_error, rms

SPEEDS, SPREADS = (0.1, 0.3, 1.0), (0.0, 0.01, 0.05)
MAX_TRANSLATION, MAX_ROTATION = 0.010, 0.3
"""The default tolerance: m, degrees."""


def scenario() -> RigScenario:
    """The robot, and the places that the board passes."""
    return RigScenario(
        camera=CameraOptions(count=2),
        laser=LaserOptions(count=1),
        spinning=SpinningOptions(count=0),
        multibeam=MultibeamOptions(count=1),
        bearings=(-40, -25, -10, 10, 25, 40),
    )


def run(seed: int, motion: MovingBoardOptions) -> list[tuple[float, float, float, bool]]:
    """By sensor: error (m, degrees), squared error per degree of freedom, and whether it is confidently wrong."""
    world = build_world(scenario(), seed, images=False)
    rig, captures, truth = simulate_moving_detections(world, seed, motion, IdealDetectorOptions(scans_per_hold=1))
    problem = build_problem_from_captures(rig, captures, RigOptions(), np.random.default_rng(seed))
    found = []
    for sensor in solve_problem(problem).sensors:
        if sensor.parent is None:
            continue
        error = measure_error(sensor.T_root_sensor, sensor.covariance, truth.T_root_sensor[sensor.name])
        off = (error.metres > MAX_TRANSLATION or error.degrees > MAX_ROTATION) and error.nees > 9 / 6 * 2
        found.append((error.metres, error.degrees, error.nees, off and sensor.verdict.grade == "good"))
    return found


def main() -> None:
    """Prints a row for each speed and spread."""
    parser = make_parser(__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--jitter", type=float, default=0.002, help="s")
    parser.add_argument("--readout", type=float, default=0.0, help="s")
    parser.add_argument("--rate", type=float, default=10.0, help="Hz")
    parser.add_argument("--speeds", type=float, nargs="+", default=SPEEDS, help="m/s")
    parser.add_argument("--spreads", type=float, nargs="+", default=SPREADS, help="s")
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)
    print(
        f"{arguments.seeds} seeds, jitter {1000 * arguments.jitter:g} ms, readout {1000 * arguments.readout:g} ms"
    )
    table = Layout("m/s:5.1f ms:4.0f RMS_mm:7.2f worst_mm:9.2f worst_deg:9.3f NEES:6.2f wrong:6d s:5.1f")
    print(table.head)
    for speed in arguments.speeds:
        for spread in arguments.spreads:
            motion = MovingBoardOptions(
                speed=speed, spread=spread, rate=arguments.rate, jitter=arguments.jitter, readout=arguments.readout
            )
            began, rows = time.perf_counter(), []
            for seed in range(arguments.first, arguments.first + arguments.seeds):
                rows += run(seed, motion)
            metres, degrees, squared, wrong = np.array(rows).T
            seconds = (time.perf_counter() - began) / arguments.seeds
            line = table.line(
                speed, 1000 * spread, 1000 * rms(metres), 1000 * metres.max(), degrees.max(), squared.mean(),
                int(wrong.sum()), seconds,
            )  # fmt: skip
            print(line, flush=True)


if __name__ == "__main__":
    main()
