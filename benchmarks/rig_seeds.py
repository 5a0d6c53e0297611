"""Worst sensor of simulated five-sensor rigs against the ground truth, recording by recording.

python benchmarks/rig_seeds.py --seeds 20                  # clean
python benchmarks/rig_seeds.py --seeds 20 --disturbed 0.1  # the board slips in 10 % of the captures
"""

import argparse
import time

import numpy as np

from calgraph.geometry import se3
from calgraph.result import Calibration
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.simulation import GroundTruth, RigScenario
from simulated import errors, poses_of, recorded


def main() -> None:
    """Prints a line for each seed, then how many are within 10 mm and 0.3 degrees."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--disturbed", type=float, default=0.0)
    arguments = parser.parse_args()
    scenario = RigScenario(disturbed=arguments.disturbed)
    print(f"{scenario.captures} captures, {arguments.disturbed:.0%} disturbed")
    print(f"{'seed':>4} {'worst mm':>9} {'worst deg':>9} {'mean mm':>8} {'mean deg':>8} {'nees/6':>7} {'s':>6}")
    good = 0
    for seed in range(arguments.seeds):
        rig, captured, truth = recorded(scenario, seed)
        began = time.perf_counter()
        calibration = solve_problem(
            build_problem_from_captures(rig, captured, RigOptions(), np.random.default_rng(seed))
        )
        seconds = time.perf_counter() - began
        metres, degrees = errors(poses_of(calibration), truth)
        complete = len(calibration.sensors) == len(rig.sensors)
        good += complete and metres.max() <= 0.010 and degrees.max() <= 0.3
        print(
            f"{seed:4d} {1000 * metres.max():9.2f} {degrees.max():9.3f} {1000 * metres.mean():8.2f} "
            f"{degrees.mean():8.3f} {_nees(calibration, truth):7.2f} {seconds:6.1f}",
            flush=True,
        )
    print(f"{good} of {arguments.seeds} with every sensor within 10 mm and 0.3 degrees")


def _nees(calibration: Calibration, truth: GroundTruth) -> float:
    """Mean normalised estimation error squared per degree of freedom: 1 where covariances are consistent."""
    values = []
    for sensor in calibration.sensors:
        if sensor.parent is not None:
            e = se3.difference(sensor.T_root_sensor, truth.T_root_sensor[sensor.name])
            values.append(e @ np.linalg.solve(sensor.covariance, e) / 6)
    return float(np.mean(values))


if __name__ == "__main__":
    main()
