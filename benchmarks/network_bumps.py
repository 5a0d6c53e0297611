"""Whether scanners of a network that are bumped are found from their static background, and no others.

A row for each bump of a random scanner at a random time, in random direction; and for worlds without a bump.
Nothing is calibrated: see network_model_errors.py for that.

    python benchmarks/network_bumps.py --seeds 20 --jobs 2
"""

import time
from typing import Any, NamedTuple

import numpy as np

from calgraph.config.settings import StationaritySettings
from calgraph.network.tracking.scan_stack import stack_scans
from calgraph.network.tracking.stationarity import MIN_REST_SHARE, analyze_stationarity
from calgraph.simulation import NetworkScenario, build_network, simulate_scans
from worlds import NAN, grouped, make_parser, run_worlds

ROOMS = ("office", "lab", "halls")
SETTINGS = StationaritySettings()
BUMPS: dict[str, tuple[float, float]] = {
    "0.3 deg": (0.3, 0.0), "1 deg": (1.0, 0.0), "3 deg": (3.0, 0.0), "10 deg": (10.0, 0.0), "90 deg": (90.0, 0.0),
    "1 cm": (0.0, 0.01), "3 cm": (0.0, 0.03), "10 cm, 10 deg": (10.0, 0.1),
}  # fmt: skip
"""Degrees and m."""
AT_REST: dict[str, dict[str, Any]] = {
    "nothing": {},
    "legs": {"people": {"shape": "legs", "count": 4}},
    "crowd": {"people": {"count": 6}},
    "chairs": {"chairs": 4},
    "mirrors": {"mirrors": 2},
    "mixed": {"errors": {"mixed": True}},
    "tilt 2 deg": {"errors": {"tilt": 2.0}},
}
MAX_SECONDS = 1.0
"""Error of a bump's time."""


class Outcome(NamedTuple):
    """Of one recording."""

    label: str
    room: str
    seed: int
    right: bool
    """One bump of the right scanner at the right time; no bump where there was none."""
    millimetres: float
    degrees: float
    seconds: float
    """Errors of its size and time; NaN without one."""
    runtime: float
    """Of all scanners, s."""


def main() -> None:
    """Prints the tables."""
    parser = make_parser(__doc__, jobs=2)
    parser.add_argument("--seeds", type=int, default=20)
    arguments = parser.parse_args()
    print(f"{'world':16}{'right':>12}{'max mm':>8}{'max deg':>9}{'max s':>7}{'ms':>7}  a recording, all scanners")
    seeds = range(arguments.seeds)
    work = [(label, room, seed) for label in (*BUMPS, *AT_REST) for room in ROOMS for seed in seeds]
    for label, outcomes in grouped(run_worlds(Outcome, check, work, arguments, key=3), lambda one: one.label):
        show(label, outcomes)


def check(label: str, room: str, seed: int) -> Outcome:
    """Simulates and tests one recording."""
    scenario: dict[str, Any] = {"layout": room, **AT_REST.get(label, {})}
    at = float(np.random.default_rng((seed, 7)).uniform(0.1, 0.9))
    turn, shift = BUMPS.get(label, (0.0, 0.0))
    if label in BUMPS:
        scenario["errors"] = {"bump_turn": turn, "bump_shift": shift, "bump_time": at}
    network = build_network(NetworkScenario.model_validate(scenario), seed)
    found = []
    runtime = 0.0
    for scanner in network.scanners:
        runs = stack_scans(simulate_scans(network, scanner))
        began = time.process_time()
        result = analyze_stationarity(runs, SETTINGS)
        runtime += time.process_time() - began
        found += [(bool(scanner.earlier), bump) for bump in result.bumps]
        if result.rest_share < MIN_REST_SHARE:
            return Outcome(label, room, seed, False, NAN, NAN, NAN, runtime)
    if label not in BUMPS:
        return Outcome(label, room, seed, not found, NAN, NAN, NAN, runtime)
    if len(found) != 1 or not found[0][0]:
        return Outcome(label, room, seed, False, NAN, NAN, NAN, runtime)
    bump = found[0][1]
    late = float(np.mean(bump.interval)) - network.scenario.start_time - at * network.scenario.duration
    return Outcome(
        label,
        room,
        seed,
        abs(late) < MAX_SECONDS,
        1000 * abs(bump.translation - shift),
        abs(abs(float(np.degrees(bump.rotation))) - turn),
        abs(late),
        runtime,
    )


def show(label: str, outcomes: list[Outcome]) -> None:
    """Prints a row."""
    right = f"{sum(one.right for one in outcomes)} of {len(outcomes)}"
    errors = np.array([one[4:7] for one in outcomes])
    worst = np.max(errors, axis=0, initial=0.0, where=np.isfinite(errors))
    runtime = 1000 * np.mean([one.runtime for one in outcomes])
    print(f"{label:16}{right:>12}{worst[0]:8.1f}{worst[1]:9.3f}{worst[2]:7.2f}{runtime:7.0f}", flush=True)


if __name__ == "__main__":
    main()
