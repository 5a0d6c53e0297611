"""Calibrations of 3-D LiDARs in halls with people: errors, NEES, verdicts, time, memory, confidently wrong ones.

python benchmarks/lidar_networks.py --seeds 0 12 --jobs 2 --csv halls.csv        # resumed from the file
python benchmarks/lidar_networks.py --rigs 16_rings mixed --duration 30          # other sensors, shorter
python benchmarks/lidar_networks.py --kinds wrong --seeds 0 13 --verbose         # a line for each sensor

Kinds are simulated in memory with bodies and rooms that the estimator does not
know. A row is one sensor besides the root; judged_sensors.py states what its columns are, and what is *confidently
wrong*. Poses are compared with those at the end, where a sensor was bumped, and with those in the middle, where
one swings. The scale is that of the positions of all sensors about their mean, over the true ones; the table has
mean and spread over networks, per mille. Errors in the plan are of x, y and yaw, which 2-D scanners of mixed
networks show; their heights and tilts are named as not observable.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from calgraph.config import Tolerance
from calgraph.geometry import Array, se3
from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import calibrate_network
from calgraph.simulation import HallFaults, HallScenario, simulate_hall
from drive_kinds import Draw, draw_size, make_faults
from judged_sensors import Outcome, Truth, judge, list_worlds, make_judging_parser, measure, show_outcomes
from worlds import NAN, finite, mean, median, run_worlds, worst

_SCANNER_HEIGHTS = (0.3, 0.9, 1.4, 0.9)
"""Of 2-D scanners beside LiDARs, m."""
RIGS: Mapping[str, Mapping[str, Any]] = {
    "16_rings": {"lidars": ("vlp16",) * 4},
    "32_rings": {"lidars": ("xt32",) * 4},
    "two": {"lidars": ("xt32",) * 2},
    "solid_state": {"lidars": ("xt32", "xt32", "solid_state", "solid_state")},
    "mixed": {"lidars": ("xt32",) * 2, "scanners": _SCANNER_HEIGHTS},
}
"""Sensors by name."""
_fault = partial(make_faults, HallFaults)
KINDS: Mapping[str, Draw] = {
    "ordinary": lambda _: {},
    "couples": lambda _: {"people": 4, "couples": 2},
    "high": lambda _: {"high": True},
    "moved": lambda rng: {"moved": int(rng.integers(3, 9))},
    "glass": lambda _: {"glass": 4},
    "mirrors": lambda _: {"mirrors": 2},
    "crowd": lambda rng: {"people": int(rng.integers(10, 15)), "couples": 3},
    "carts": lambda _: {"people": 0, "carts": 3},
    "one_person": lambda _: {"people": 1},
    "nobody": lambda _: {"people": 0},
    "sloping_floor": lambda _: {"floor_slope": 0.03},
    "stairs": lambda _: {"stairs": True},
    "rain": _fault(lambda rng: {"false_returns": draw_size(0.003, 0.1, rng)}),
    "bump": _fault(lambda rng: {"bump": (draw_size(0.005, 0.05, rng), draw_size(0.05, 2.0, rng))}),
    "swing": _fault(lambda rng: {"swing": draw_size(0.05, 1.0, rng)}),
    "rings": _fault(lambda _: {"ring_bias": 0.03}),
    "clock_drift": _fault(lambda rng: {"clock_drift": draw_size(2e-4, 3e-3, rng)}),
    "clock_jump": _fault(lambda rng: {"clock_jump": draw_size(0.01, 0.2, rng)}),
    "stretched": _fault(lambda rng: {"range_scale": float(rng.choice([-0.01, 0.01]))}),
}
"""Changes to the scenario by kind, drawn by seed."""
WRONG = tuple(kind for kind in KINDS if kind not in ("ordinary", "couples", "high"))
"""The kinds in which something is wrong or missing."""
COLUMNS = "scale:6.2f std:5.2f plan:6.1f max:6.1f yaw:6.3f max:6.3f"


@dataclass(frozen=True)
class NetworkOutcome(Outcome):
    """Of one sensor of one network, the root left out."""

    scale: float = NAN
    """Of the network over the true one, less 1."""
    plan_millimetres: float = NAN
    """Error in the plan, and about the vertical."""
    yaw_degrees: float = NAN


def main() -> None:
    """Prints a table by kind and rig, what is confidently wrong, and all reasons."""
    rigs = ["32_rings", *(rig for rig in RIGS if rig != "32_rings")]
    arguments = make_judging_parser(__doc__, list(KINDS), ["ordinary"], rigs, (0.02, 0.3)).parse_args()
    work = list_worlds(arguments, WRONG, tuple(arguments.tolerance))
    outcomes = run_worlds(NetworkOutcome, run, work, arguments, key=4)
    show_outcomes(outcomes, arguments.verbose, COLUMNS, summarize_networks)


def build_hall_scenario(kind: str, seed: int, rig: str = "32_rings", duration: float = 60.0) -> HallScenario:
    """The scenario of one run: two to four people, but for kinds that state their number.

    Args:
        kind: of :data:`KINDS`.
        seed: of the hall, and of what the kind draws.
        rig: of :data:`RIGS`.
        duration: s.
    """
    rng = np.random.default_rng((seed, 1000))
    scenario = HallScenario(seed=seed, duration=duration, people=2 + seed % 3, **RIGS[rig])
    return replace(scenario, **KINDS[kind](rng))


def run(kind: str, rig: str, seed: int, duration: float, tolerance: tuple[float, ...]) -> list[NetworkOutcome]:
    """Simulates and calibrates one network."""
    began = time.process_time()
    hall = simulate_hall(build_hall_scenario(kind, seed, rig, duration))
    metres, degrees = tolerance
    stated = hall.rig.model_copy(update={"tolerance": Tolerance(translation=metres, rotation=degrees)})
    truth = Truth(hall.truth.T_root_sensor, hall.truth.clock_offsets)
    first = NetworkOutcome(kind, rig, seed, duration, "", simulated_seconds=time.process_time() - began)
    row, found = measure(first, lambda: calibrate_network(stated, hall.recording, NetworkOptions(seed=seed)))
    if found is None:
        return [row]
    poses = {one.name: one.T_root_sensor for one in found.sensors}
    row = replace(row, scale=measure_scale(poses, truth.T_root_sensor))
    rows = [judge(replace(row, sensor=name), found, truth) for name in stated.sensors if name != found.root]
    return [measure_plan(one, poses, truth, hall.truth.T_world_root) for one in rows]


def measure_plan(
    row: NetworkOutcome, poses: Mapping[str, Array], truth: Truth, T_world_root: Array
) -> NetworkOutcome:
    """The row of a sensor with its errors in the plan."""
    if row.sensor not in poses:
        return row
    error = se3.difference(poses[row.sensor], truth.T_root_sensor[row.sensor])
    shift, turn = (T_world_root[:3, :3] @ part for part in (error[:3], error[3:]))
    return replace(
        row, plan_millimetres=1000 * float(np.hypot(*shift[:2])), yaw_degrees=float(np.degrees(abs(turn[2])))
    )


def measure_scale(poses: Mapping[str, Array], true: Mapping[str, Array]) -> float:
    """Size of a network over the true one, less 1; NaN for less than two sensors."""
    if len(poses) < 2:
        return NAN
    spread, true_spread = (
        np.linalg.norm(places - places.mean(axis=0))
        for places in (np.array([one[name][:3, 3] for name in poses]) for one in (poses, true))
    )
    return float(spread / true_spread - 1)


def summarize_networks(networks: Sequence[Sequence[NetworkOutcome]]) -> tuple[float, ...]:
    """Mean and spread of scales, per mille; medians and largest errors in the plan, mm and degrees."""
    scales = 1000 * finite([some[0].scale for some in networks])
    every = [one for some in networks for one in some]
    plan, yaw = [one.plan_millimetres for one in every], [one.yaw_degrees for one in every]
    spread = float(scales.std()) if len(scales) else NAN
    return mean(scales), spread, median(plan), worst(plan), median(yaw), worst(yaw)


if __name__ == "__main__":
    main()
