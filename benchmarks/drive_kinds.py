"""Kinds of simulated drives: ordinary ones, and those that determine too little or in which something is wrong.

python benchmarks/drive_kinds.py                                  # CPU time and memory of drives of a minute
python benchmarks/drive_kinds.py --rigs four_lidars --seeds 3 4   # some rigs, some seeds
python benchmarks/drive_kinds.py --kinds truck field              # some kinds

Sectors of 130, 80 or 56 degrees, columns of 16 beams every 0.8 degrees at 10 Hz, 60 s, mean of three seeds on one
core: 6 s of CPU for two to four LiDARs (at most 8), 7 s with a solid-state LiDAR, 11 s with a 2-D scanner; 0.4 to
0.9 GB.
"""

import argparse
import resource
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from calgraph.simulation import STANDARD_RIGS, DriveFaults, DriveScenario, simulate_drive
from calgraph.simulation.drive_scenario import RigName

RIGS: tuple[RigName, ...] = (
    "two_lidars",
    "three_lidars",
    "four_lidars",
    "lidar_and_solid_state",
    "lidar_and_scanner",
    "mixed",
)


def _spread(low: float, high: float, rng: np.random.Generator) -> float:
    """A size between two limits, each order of magnitude as likely."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _fault(
    draw: Callable[[np.random.Generator], dict[str, Any]],
) -> Callable[[np.random.Generator], dict[str, Any]]:
    """Changes of a scenario by faults, which occur somewhere between 30 and 70 % of the drive."""
    return lambda rng: {"faults": DriveFaults(time=float(rng.uniform(0.3, 0.7)), **draw(rng))}


KINDS: dict[str, Callable[[np.random.Generator], dict[str, Any]]] = {
    "ordinary": lambda _: {},
    "planar": lambda _: {"path": "planar"},
    "clocks_half_a_second": lambda _: {"max_clock_offset": 0.5},
    "straight": lambda _: {"path": "straight"},
    "constant_turn": lambda _: {"path": "constant_turn", "world": "hall"},
    "turn_on_spot": lambda _: {"path": "turn_on_spot"},
    "corridor": lambda _: {"path": "straight", "world": "corridor", "people": 0},
    "corridor_both_ways": lambda _: {"world": "corridor", "people": 0},
    "field": lambda _: {"world": "field", "people": 0, "cars": 0},
    "truck": _fault(lambda _: {"truck": True}),
    "bump": _fault(lambda rng: {"bump": (_spread(0.005, 0.05, rng), _spread(0.05, 2.0, rng))}),
    "clock_drift": _fault(lambda rng: {"clock_drift": _spread(2e-4, 3e-3, rng)}),
    "clock_jump": _fault(lambda rng: {"clock_jump": _spread(0.01, 0.2, rng)}),
    "stretched": _fault(lambda rng: {"range_scale": float(rng.choice([-0.01, 0.01]))}),
}
"""Changes to the scenario by kind, drawn by seed; trucks need a yard or a hall."""
OUTDOORS = ("truck",)


def build_drive_scenario(
    kind: str, seed: int, rig: RigName = "two_lidars", duration: float = 60.0
) -> DriveScenario:
    """The scenario of one run.

    Args:
        kind: of :data:`KINDS`.
        seed: of the drive, and of what the kind draws.
        rig: of the standard rigs.
        duration: s.
    """
    rng = np.random.default_rng((seed, 1000))
    scenario = DriveScenario(seed=seed, duration=duration, sensors=STANDARD_RIGS[rig])
    if kind in OUTDOORS:
        scenario = replace(scenario, world=("yard", "hall")[seed % 2])
    return replace(scenario, **KINDS[kind](rng))


def main() -> None:
    """Measures the simulation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", nargs="+", choices=STANDARD_RIGS, default=RIGS)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=["ordinary"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--duration", type=float, default=60.0)
    options = parser.parse_args()
    for rig in options.rigs:
        for kind in options.kinds:
            seconds, sizes = [], []
            for seed in options.seeds:
                scenario = build_drive_scenario(kind, seed, rig, options.duration)
                start = time.process_time()
                drive = simulate_drive(scenario)
                seconds.append(time.process_time() - start)
                sizes.append(len(drive.truth.world.surfaces))
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
            print(
                f"{rig:24} {kind:20} {np.mean(seconds):5.1f} s of CPU, at most {max(seconds):.1f}; "
                f"{np.mean(sizes):.0f} surfaces; {peak:.2f} GB at the peak so far"
            )


if __name__ == "__main__":
    main()
