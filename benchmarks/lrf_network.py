"""Tables I-IV of the network's paper on simulated counterparts of its recordings, beside the default's accuracy.

Quenzel, Papenberg, Behnke, "Robust extrinsic calibration of multiple stationary laser range finders", ICRA 2016.
Errors are of all scanners but the root, over all seeds, against the truth; scanners without a pose have none, and
are counted as grossly wrong, as are those off by more than 0.5 m or 5 degrees.

What is not as in the paper: everything is simulated. On its ring of 60 m with a range of 20 m the cuboid in the
middle, the only background, is out of every scanner's sight, and neighbours see the cylinder together for about
4 s in a minute. "ring" is therefore one of 46 m, the smallest on which still only neighbours see the cylinder
together, of 3 minutes; "ring60" is the paper's, of 3 minutes, without any background. Recordings of the others are
one minute. Pairs are fitted with the depth of centres behind what is seen as an unknown, whatever the feature.

    python benchmarks/lrf_network.py --seeds 20 --jobs 2
    python benchmarks/lrf_network.py --seeds 3 --scenarios halls --tables 3 summary
"""

import argparse
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from calgraph.calibrate import DEPTHS
from calgraph.geometry import Array, se2
from calgraph.graph import Averaged, PoseGraph, average_network, covariances, network_graph, trust
from calgraph.graph.trees import tree_poses
from calgraph.pairwise import TrackPair, estimate_network_pairs
from calgraph.pairwise.samples import meetings, sample
from calgraph.rig import Cylinder, Lidar2dSpec, People, Rig
from calgraph.sensors import LaserScan
from calgraph.simulation import NetworkScenario, Truth, build_network, network_rig, network_truth, scans_of
from calgraph.tracking import Feature, Tracked, track_scanner

SCENARIOS: Mapping[str, dict[str, Any]] = {
    "ring": {"layout": "ring", "ring_diameter": 46.0, "duration": 180.0},
    "ring60": {"layout": "ring", "duration": 180.0},
    "semicircle": {"layout": "semicircle"},
    "office": {"layout": "office"},
    "lab": {"layout": "lab"},
    "halls": {"layout": "halls"},
}
CYLINDER = ("ring", "ring60")
FEATURES: tuple[Feature, ...] = ("com", "ellipse", "nls")
USUAL_PEOPLE = 2
TABLES = ("1", "2", "3", "4", "summary")
GROSS = (5.0, 0.5)
"""Degrees and metres."""
DISCARDED = 0.2
"""Root mean square distance above which a plain threshold discards a pair, m."""

Average = Literal["consensus", "l1mc", "triangles", "spectral", "irls", "none"]


class Cell(NamedTuple):
    """One kind of recording."""

    scenario: str
    people: int


class Setup(NamedTuple):
    """One way to calibrate a recording."""

    feature: Feature
    icp: bool
    average: Average
    weighted: bool


DEFAULT = Setup("nls", True, "consensus", True)


@dataclass(frozen=True, eq=False)
class Run:
    """What came of one recording."""

    errors: Mapping[Setup, Array]
    """(S, 2) degrees and metres of each scanner but the root; NaN where there is no pose."""
    nees: Array
    """(S,) of the default: squared errors over their covariances, per degree of freedom."""
    pairs: Array
    """(P, 2) of the published pairs: whether right, and the root mean square distance of what both saw, m."""


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3, help="recordings of each kind")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--scenarios", nargs="+", default=list(SCENARIOS), choices=SCENARIOS)
    parser.add_argument("--people", type=int, nargs="+", default=[1, 2, 3, 4], help="in office and lab")
    parser.add_argument("--tables", nargs="+", default=list(TABLES), choices=TABLES)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    arguments = parser.parse_args()
    cells = [cell for name in arguments.scenarios for cell in cells_of(name, arguments.people)]
    setups = {cell: setups_of(cell, arguments.tables) for cell in cells}
    cells = [cell for cell in cells if setups[cell]]
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    runs: dict[Cell, list[Run]] = {cell: [] for cell in cells}
    with ProcessPoolExecutor(arguments.jobs) as pool:
        jobs = [(cell, pool.submit(run, cell, seed, setups[cell])) for seed, cell in product(seeds, cells)]
        for done, (cell, job) in enumerate(jobs, start=1):
            runs[cell].append(job.result())
            print(f"\r{done} of {len(jobs)} recordings", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    for name in arguments.tables:
        PRINTED[name](runs)


def cells_of(scenario: str, people: Sequence[int]) -> list[Cell]:
    """The recordings of a scenario: office and lab with any number of people."""
    if scenario in CYLINDER:
        return [Cell(scenario, 1)]
    if scenario in ("office", "lab"):
        return [Cell(scenario, count) for count in people]
    return [Cell(scenario, 1), Cell(scenario, USUAL_PEOPLE)]


def usual(cell: Cell) -> bool:
    """Whether so many people are usual in this scenario."""
    return cell.people == USUAL_PEOPLE or cell.scenario in CYLINDER


def setups_of(cell: Cell, tables: Iterable[str]) -> tuple[Setup, ...]:
    """All that the tables want to know of one kind of recording, features by features."""
    wanted: set[Setup] = set()
    for table in tables:
        if table == "1" and cell.people == 1:
            wanted.add(PUBLISHED)
        elif table == "2" and cell == Cell("office", USUAL_PEOPLE):
            wanted |= {Setup(f, False, m, False) for f, m in product(FEATURES, get_args(Average))}
        elif table == "3" and usual(cell):
            wanted |= {*AVERAGED, DEFAULT}
        elif table == "4" and cell.scenario == "lab":
            wanted |= {*BY_PEOPLE, DEFAULT}
        elif table == "summary":
            wanted.add(DEFAULT)
    return tuple(sorted(wanted))


PUBLISHED = Setup("com", True, "l1mc", False)
COMPARED: tuple[Average, ...] = ("l1mc", "spectral", "consensus")
AVERAGED = tuple(Setup("com", True, m, weighted) for weighted, m in product((True, False), COMPARED))
BY_PEOPLE = tuple(Setup("nls", False, method, False) for method in COMPARED)


def run(cell: Cell, seed: int, setups: Sequence[Setup]) -> Run:
    """Simulates one recording and calibrates it in all these ways, each stage once."""
    knobs = SCENARIOS[cell.scenario]
    network = build_network(NetworkScenario(**knobs, people={"count": cell.people}), seed)  # type: ignore[arg-type]
    rig, truth = network_rig(network), planar(network_truth(network))
    scans = {scanner.name: list(scans_of(network, scanner)) for scanner in network.scanners}
    errors: dict[Setup, Array] = {}
    nees, judged = np.zeros(0), np.zeros((0, 2))
    for feature in {setup.feature for setup in setups}:
        tracked = follow(rig, scans, feature)
        for icp in {setup.icp for setup in setups if setup.feature == feature}:
            rng = np.random.default_rng(seed)
            found = estimate_network_pairs(tracked, rng, icp=icp, depth=DEPTHS[feature])
            pairs = [pair for pair in found.values() if isinstance(pair, TrackPair)]
            if feature == "com" and icp:
                judged = np.array([judge(pair, tracked, truth) for pair in pairs]).reshape(-1, 2)
            for setup in (s for s in setups if (s.feature, s.icp) == (feature, icp)):
                averaged, graph, names = poses(pairs, setup, network.root, rng)
                errors[setup] = errors_of(averaged, names, truth)
                if setup == DEFAULT:
                    nees = nees_of(averaged, graph, names, truth)
    return Run(errors, nees, judged)


def follow(rig: Rig, scans: Mapping[str, list[LaserScan]], feature: Feature) -> dict[str, Tracked]:
    """What each scanner followed, of those that followed anything."""
    assert isinstance(rig.target, People | Cylinder)
    tracked: dict[str, Tracked] = {}
    for name, spec in rig.sensors.items():
        assert isinstance(spec, Lidar2dSpec)
        found = track_scanner(partial(iter, scans[name]), rig.target, spec.noise, feature=feature)
        if isinstance(found, Tracked):
            tracked[name] = found
    return tracked


def planar(truth: Truth) -> dict[str, Array]:
    """T_root_sensor (3, 3) by sensor."""
    in_plane = np.ix_((0, 1, 3), (0, 1, 3))
    return {name: T[in_plane] for name, T in truth.T_root_sensor.items()}


def poses(
    pairs: Sequence[TrackPair], setup: Setup, root: str, rng: np.random.Generator
) -> tuple[Averaged, PoseGraph, tuple[str, ...]]:
    """Poses of the connected scanners, in the order of their names; the published way has one estimate a pair."""
    if setup.average != "consensus":
        pairs = [replace(pair, hypotheses=pair.hypotheses[:1]) for pair in pairs]
    graph, names = network_graph(root, pairs)
    if setup.average != "none":
        weights = trust(names, pairs) if setup.weighted else None
        return *average_network(graph, rng, setup.average, weights), names
    # The pair with the root where there is one, otherwise the fewest and best pairs.
    costs = np.array([1 + pair.hypotheses[0].cost for pair in pairs if pair.sensor_a in names])
    return Averaged(tree_poses(graph, costs[None])[0], np.ones(len(costs), dtype=np.bool_)), graph, names


def errors_of(averaged: Averaged, names: Sequence[str], truth: Mapping[str, Array]) -> Array:
    """(S, 2) degrees and metres of all scanners but the root, NaN without a pose."""
    found = dict(zip(names, averaged.T_root_node, strict=True))
    nowhere = np.full((3, 3), np.nan)
    others = [name for name in truth if name != names[0]]
    off = np.array([se2.difference(found.get(name, nowhere), truth[name]) for name in others])
    return np.column_stack([np.degrees(np.abs(off[:, 2])), np.hypot(off[:, 0], off[:, 1])])


def nees_of(averaged: Averaged, graph: PoseGraph, names: Sequence[str], truth: Mapping[str, Array]) -> Array:
    """(S,) normalised estimation errors squared per degree of freedom of all scanners found but the root."""
    off = np.array([se2.difference(T, truth[name]) for T, name in zip(averaged.T_root_node, names, strict=True)])
    spread = covariances(graph.where(averaged.inliers), averaged.T_root_node)
    return np.array([e @ np.linalg.solve(C, e) / 3 for e, C in zip(off[1:], spread[1:], strict=True)])


def judge(pair: TrackPair, tracked: Mapping[str, Tracked], truth: Mapping[str, Array]) -> tuple[bool, float]:
    """Whether a pair is right, and the root mean square distance of all that a saw from what b did, m."""
    true = se2.inverse(truth[pair.sensor_a]) @ truth[pair.sensor_b]
    off = se2.difference(pair.T_a_b, true)
    right = np.degrees(abs(off[2])) < GROSS[0] and np.hypot(off[0], off[1]) < GROSS[1]
    met = meetings(sample(tracked[pair.sensor_a]), sample(tracked[pair.sensor_b]))
    squared = np.sum((se2.apply(pair.T_a_b, met.x_b) - met.x_a) ** 2, axis=1)
    return bool(right), float(np.sqrt(np.mean(np.minimum.reduceat(squared, met.starts_a))))


Runs = Mapping[Cell, Sequence[Run]]


def table_1(runs: Runs) -> None:
    """Prints which right pairs a plain threshold would discard."""
    print("\nTable I, 1 person: right pairs that a threshold of 20 cm root mean square discards, and wrong pairs")
    print(f"{'scenario':12}{'pairs':>7}{'discarded %':>13}{'wrong %':>9}")
    for cell in (cell for cell in runs if cell.people == 1):
        judged = np.concatenate([found.pairs for found in runs[cell]])
        right = judged[:, 0] == 1
        discarded = 100 * np.mean(judged[right, 1] > DISCARDED)
        print(f"{cell.scenario:12}{len(judged):7d}{discarded:13.1f}{100 * np.mean(~right):9.1f}")


def table_2(runs: Runs) -> None:
    """Prints features against graph methods."""
    cell = Cell("office", USUAL_PEOPLE)
    if cell not in runs:
        return
    print("\nTable II: features, office, without ICP (none: chained pairs without averaging)")
    print(f"{'feature':9}{'average':11}{HEADER}")
    for feature, method in product(FEATURES, get_args(Average)):
        print(f"{feature:9}{method:11}{summary(runs[cell], Setup(feature, False, method, False))}")


def table_3(runs: Runs) -> None:
    """Prints scenarios against weights and averaging."""
    print("\nTable III: all scenarios, centre of mass and ICP; the default at the end of each")
    print(f"{'scenario':12}{'weights':10}{'average':11}{HEADER}")
    for cell in filter(usual, runs):
        for setup in AVERAGED:
            weights = "weighted" if setup.weighted else "uniform"
            print(f"{cell.scenario:12}{weights:10}{setup.average:11}{summary(runs[cell], setup)}")
        print(f"{cell.scenario:12}{'default':21}{summary(runs[cell], DEFAULT)}")


def table_4(runs: Runs) -> None:
    """Prints the number of people."""
    print("\nTable IV: number of people, lab, nls without ICP; the default, with ICP, at the end of each")
    print(f"{'people':12}{'average':11}{HEADER}")
    for cell in (cell for cell in runs if cell.scenario == "lab"):
        for setup in BY_PEOPLE:
            print(f"{cell.people:<12d}{setup.average:11}{summary(runs[cell], setup)}")
        print(f"{cell.people:<12d}{'default':11}{summary(runs[cell], DEFAULT)}")


def table_default(runs: Runs) -> None:
    """Prints accuracy, reliability and honesty of the default."""
    print("\nThe default: errors, recordings without a grossly wrong scanner, squared errors over covariances")
    print(f"{'scenario':12}{'people':8}{HEADER}{'clean':>10}{'nees/3':>8}")
    for cell, found in runs.items():
        clean = sum(not gross(one.errors[DEFAULT]).any() for one in found)
        nees = np.mean(np.concatenate([one.nees for one in found]))
        row = f"{cell.scenario:12}{cell.people:<8d}{summary(found, DEFAULT)}"
        print(f"{row}{f'{clean} of {len(found)}':>10}{nees:8.2f}")


HEADER = f"{'mean deg':>10}{'median':>9}{'mean m':>9}{'median':>9}{'gross':>7}{'of':>5}"


def summary(runs: Sequence[Run], setup: Setup) -> str:
    """Mean and median errors of all scanners that have a pose, and how many are grossly wrong or have none."""
    errors = np.concatenate([one.errors[setup] for one in runs])
    (degrees, metres), (middle, halfway) = np.nanmean(errors, axis=0), np.nanmedian(errors, axis=0)
    return f"{degrees:10.4f}{middle:9.4f}{metres:9.4f}{halfway:9.4f}{gross(errors).sum():7d}{len(errors):5d}"


def gross(errors: Array) -> NDArray[np.bool_]:
    """(S,) whether errors (S, 2) are grossly wrong or missing."""
    return np.asarray(~(errors < np.array(GROSS)).all(axis=1))


PRINTED: Mapping[str, Callable[[Runs], None]] = {
    "1": table_1, "2": table_2, "3": table_3, "4": table_4, "summary": table_default,
}  # fmt: skip


if __name__ == "__main__":
    main()
