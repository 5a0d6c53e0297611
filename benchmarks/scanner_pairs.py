"""Pairs of networks that are registered as candidates, against all pairs: right pairs that are lost, and time.

A pair is right if one of its hypotheses is within 0.5 m and 5 degrees of the ground truth. Networks are grids
unless another layout is named; they last one minute. All pairs are also registered with other random numbers, as
proposals of crowds are drawn at random: "changed" are the right pairs that are lost then. "sigma" is the largest
difference of a right pair, in standard deviations.

    python benchmarks/scanner_pairs.py --seeds 2
    python benchmarks/scanner_pairs.py --cases "100 scanners"
"""

import time
from collections.abc import Mapping
from typing import Any
from unittest import mock

import numpy as np

from calgraph.errors import Rejected
from calgraph.geometry import Array, se2
from calgraph.network.pairs import scanner_pair
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate, estimate_scanner_pairs
from calgraph.network.tracking.track import ScannerTracks
from calgraph.simulation import NetworkScenario, build_network, network_rig, network_truth, simulate_scans
from network_runs import project_poses, track_scanners
from worlds import make_parser

RIGHT = 0.5, np.radians(5)
"""Largest errors of right pairs, m and rad."""


def grid(count: int, walkers: int, *, scanner: Mapping[str, Any] = {}, **others: Any) -> dict[str, Any]:
    """A grid with as much furniture as the benchmark of stages."""
    people_options = {"count": walkers, **others.pop("people", {})}
    scanner_options = {"count": count, **scanner}
    return {"layout": "grid", "clutter": 2 * count, "scanner": scanner_options, "people": people_options, **others}


CASES: dict[str, dict[str, Any]] = {
    "30 scanners": grid(30, 12),
    "clocks 50 ms": grid(30, 12, scanner={"clock_offset": 0.05}),
    "clocks 0.8 s": grid(30, 12, scanner={"clock_offset": 0.8}),
    "legs": grid(30, 12, people={"shape": "legs"}),
    "two people": grid(30, 2),
    "40 people": grid(30, 40),
    "couples, carts": grid(30, 12, people={"couples": 3, "carts": 2}),
    "upside-down": grid(30, 12, errors={"inverted": 5}),
    "12 s": grid(30, 12, duration=12.0),
    "spacing 10 m": grid(30, 12, grid_spacing=10.0),
    "40 in 3.5 m": grid(40, 6, grid_spacing=3.5),
    "office": {"layout": "office", "scanner": {"count": 20}, "people": {"count": 4}},
    "ring": {"layout": "ring", "ring_diameter": 80.0, "scanner": {"count": 24}, "people": {"count": 2}},
    "100 scanners": grid(100, 40),
}

Pairs = Mapping[tuple[str, str], ScannerPairEstimate | Rejected]


def main() -> None:
    """Prints the table."""
    parser = make_parser(__doc__)
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=CASES)
    parser.add_argument("--seeds", type=int, default=1, help="recordings of each kind")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    arguments = parser.parse_args()
    heads = ("all", "tried", "right", "lost", "won", "changed", "wrong", "now", "seconds", "now", "sigma")
    print(f"{'':16}{'seed':>5}" + "".join(f"{head:>9}" for head in heads))
    for name in arguments.cases:
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            print(f"{name:16}{seed:5d}{compare(NetworkScenario(**CASES[name]), seed)}", flush=True)


def compare(scenario: NetworkScenario, seed: int) -> str:
    """A row of the table."""
    network = build_network(scenario, seed)
    rig, truth = network_rig(network), project_poses(network_truth(network))
    scans = {scanner.name: list(simulate_scans(network, scanner)) for scanner in network.scanners}
    tracked = track_scanners(rig, scans, "nls")
    every, seconds = register(tracked, 1000, 0)
    others, _ = register(tracked, 1000, 1)
    candidates, fewer_seconds = register(tracked, scanner_pair.MAX_EXHAUSTIVE, 0)
    right, again, found = (find_right(pairs, truth) for pairs in (every, others, candidates))
    wrong, still = (count_poses(pairs) - len(good) for pairs, good in ((every, right), (candidates, found)))
    counts = (len(every), len(candidates), len(right), len(right - found), len(found - right))
    numbers = "".join(f"{count:9d}" for count in (*counts, len(right - again), wrong, still))
    difference = max((whiten(every[ends], candidates[ends]) for ends in right & found), default=0.0)
    return f"{numbers}{seconds:9.1f}{fewer_seconds:9.1f}{difference:9.2f}"


def register(tracked: Mapping[str, ScannerTracks], max_exhaustive: int, seed: int) -> tuple[Pairs, float]:
    """The pairs, of which all are registered up to a number of scanners, and the processor time, s."""
    begin = time.process_time()
    with mock.patch.object(scanner_pair, "MAX_EXHAUSTIVE", max_exhaustive):
        pairs = estimate_scanner_pairs(tracked, np.random.default_rng(seed))
    return pairs, time.process_time() - begin


def find_right(pairs: Pairs, truth: Mapping[str, Array]) -> set[tuple[str, str]]:
    """Pairs with a right hypothesis."""
    right = set()
    for (a, b), pair in pairs.items():
        if isinstance(pair, ScannerPairEstimate):
            T = np.array([hypothesis.T_a_b for hypothesis in pair.hypotheses])
            off = se2.difference(T, se2.inverse(truth[a]) @ truth[b])
            if np.any((np.hypot(off[:, 0], off[:, 1]) < RIGHT[0]) & (np.abs(off[:, 2]) < RIGHT[1])):
                right.add((a, b))
    return right


def count_poses(pairs: Pairs) -> int:
    """Pairs that are not rejected."""
    return sum(isinstance(pair, ScannerPairEstimate) for pair in pairs.values())


def whiten(pair: ScannerPairEstimate | Rejected, other: ScannerPairEstimate | Rejected) -> float:
    """Difference of two poses of a pair, in standard deviations."""
    if isinstance(pair, Rejected) or isinstance(other, Rejected):
        return np.inf
    off = se2.difference(other.T_a_b, pair.T_a_b)
    return float(np.sqrt(off @ pair.information @ off))


if __name__ == "__main__":
    main()
