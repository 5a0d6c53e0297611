"""Tables I-IV of the network's paper on simulated counterparts of its recordings, beside the estimators here.

Quenzel, Papenberg, Behnke, "Robust extrinsic calibration of multiple stationary laser range finders", 2016.
Errors are of all scanners but the root, over all seeds, against the ground truth. Scanners without a pose have
none, and are counted as grossly wrong, as are those off by more than 0.5 m or 5 degrees.

Differences from the paper: everything is simulated. On its ring of 60 m with a range of 20 m, the cuboid in the
middle, the only background, is out of every scanner's range, and neighbours detect the cylinder simultaneously for
about 4 s in a minute. "ring" is therefore one of 46 m, the smallest on which only neighbours detect the cylinder
simultaneously, of 3 minutes; "ring60" is the paper's, of 3 minutes, without background. Other recordings last one
minute. Pairs are fitted with the depth of centres behind the hits as an unknown, for all features.

"averaging" is the consensus over trees of weighted pairs of ellipses; "joint" is the default, which starts
there. Table 5 has both beside the published method (centres of mass, ICP, uniform L1MC), on the same recordings:
unchanged; with clocks that differ by up to 50 ms; with bodies 30 % larger (even seeds) or smaller than stated; and
with people who swing their arms. A cylinder with a wrong size is stated as people of that size: the prior of a
diameter is tight.

    python benchmarks/lrf_network.py --seeds 20 --jobs 2
    python benchmarks/lrf_network.py --seeds 3 --scenarios halls --tables 3 summary
    python benchmarks/lrf_network.py --seeds 20 --jobs 2 --tables 5
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Cylinder, Lidar2dSpec, People, Rig
from calgraph.config.settings import CenterFeature, NetworkEstimationSettings, TrackingSettings
from calgraph.geometry import Array, se2
from calgraph.graph.averaging import select_averaging
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.graph.random_trees import compute_tree_poses
from calgraph.network.graph.network_graph import (
    average_network,
    build_network_graph,
    compute_joint_covariance,
    published_weights,
)
from calgraph.network.graph.network_initialization import initialize_network
from calgraph.network.joint.estimate import solve_network
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate, estimate_scanner_pairs
from calgraph.network.pairs.synchronized_tracks import pair_samples, resample_tracks
from calgraph.network.pairs.visibility_map import ScannerObservations
from calgraph.network.scanner_pairs import DEPTH_STDDEV_OF
from calgraph.network.track_recording import select_center_estimator
from calgraph.network.tracking.track import ScannerTracks
from calgraph.network.tracking.track_scanner import track_scanner
from calgraph.sensors import LaserScan
from calgraph.simulation import (
    GroundTruth,
    NetworkScenario,
    build_network,
    network_rig,
    network_truth,
    simulate_scans,
)
from worlds import grouped, make_parser, run_worlds

SCENARIOS: Mapping[str, dict[str, Any]] = {
    "ring": {"layout": "ring", "ring_diameter": 46.0, "duration": 180.0},
    "ring60": {"layout": "ring", "duration": 180.0},
    "semicircle": {"layout": "semicircle"},
    "office": {"layout": "office"},
    "lab": {"layout": "lab"},
    "halls": {"layout": "halls"},
}
CYLINDER = ("ring", "ring60")
FEATURES: tuple[CenterFeature, ...] = ("com", "ellipse", "nls")
USUAL_PEOPLE = 2
GROSS = (5.0, 0.5)
"""Degrees and metres."""

Average = Literal["consensus", "l1mc", "triangles", "spectral", "irls", "none"]


Condition = Literal["as is", "clocks", "radii", "arms"]
CONDITIONS: Mapping[str, tuple[Condition, ...]] = {
    "ring": ("as is", "clocks", "radii"),
    **dict.fromkeys(("office", "lab", "halls"), get_args(Condition)),
}
"""Of Table 5, by scenario: a cylinder has no arms."""
CLOCKS, ARMS, SIZES = 0.05, 0.15, (1.3, 0.7)
"""Largest clock offset, s; amplitude of arms, m; true radii over those stated, for even and odd seeds."""


class Cell(NamedTuple):
    """One kind of recording."""

    scenario: str
    people: int
    condition: Condition = "as is"


class Setup(NamedTuple):
    """A method of calibration."""

    feature: CenterFeature
    icp: bool
    average: Average
    weighted: bool
    joint: bool = False


PUBLISHED = Setup("com", True, "l1mc", False)
AVERAGING = Setup("nls", True, "consensus", True)
JOINT = AVERAGING._replace(joint=True)
OURS = {"averaging": AVERAGING, "joint": JOINT}
DISCARDED = 0.2
"""Root mean square distance above which a plain threshold discards a pair, m."""
COMPARED: tuple[Average, ...] = ("l1mc", "spectral", "consensus")
AVERAGED = tuple(Setup("com", True, m, weighted) for weighted, m in product((True, False), COMPARED))
BY_PEOPLE = tuple(Setup("nls", False, method, False) for method in COMPARED)


def main() -> None:
    """Prints the tables."""
    parser = make_parser(__doc__, jobs=1)
    parser.add_argument("--seeds", type=int, default=3, help="recordings of each kind")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--scenarios", nargs="+", default=list(SCENARIOS), choices=SCENARIOS)
    parser.add_argument("--people", type=int, nargs="+", default=[1, 2, 3, 4], help="in office and lab")
    parser.add_argument("--tables", nargs="+", default=list(PRINTED), choices=PRINTED)
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    cells = [cell for name in arguments.scenarios for cell in list_cells(name, arguments.people)]
    setups = {cell: setups_of(cell, arguments.tables) for cell in cells}
    names = {format_setup(setup): setup for wanted in setups.values() for setup in wanted}
    work = [
        (*cell, seed, "; ".join(map(format_setup, setups[cell])))
        for seed, cell in product(seeds, cells)
        if setups[cell]
    ]
    rows = run_worlds(Row, measure, work, arguments, key=5)
    runs: dict[Cell, list[Run]] = {cell: [] for cell in cells if setups[cell]}
    for _, found in grouped(rows, lambda row: (row.cell, row.seed)):
        errors, nees = ({names[row.setup]: getattr(row, name) for row in found} for name in ("errors", "nees"))
        runs[found[0].cell].append(Run(errors, nees, found[0].clocks, found[0].pairs.reshape(-1, 2)))
    as_is = {cell: found for cell, found in runs.items() if cell.condition == "as is"}
    for name in arguments.tables:
        PRINTED[name](runs if name == "5" else as_is)


@dataclass(frozen=True, eq=False)
class Solved:
    """Result of one setup."""

    names: tuple[str, ...]
    """Scanners that are connected, the root first."""
    T_root_scanner: Array
    """(N, 3, 3)."""
    covariance: Array
    """(3N, 3N) of the poses."""
    offset: Array
    """(N,) scanner clock minus root clock, s; NaN where it was not estimated."""


@dataclass(frozen=True, eq=False)
class Run:
    """Errors of one recording."""

    errors: Mapping[Setup, Array]
    """(S, 2) degrees and metres of each scanner but the root; NaN where there is no pose."""
    nees: Mapping[Setup, Array]
    """(S,) squared errors over their covariances, per degree of freedom, of what has a pose."""
    clocks: Array
    """(S,) errors of the clock offsets that the joint solution has, s."""
    pairs: Array
    """(P, 2) of the published pairs: whether right, and the RMS distance of simultaneous positions, m."""


def list_cells(scenario: str, people: Sequence[int]) -> list[Cell]:
    """The recordings of a scenario: office and lab with any number of people, the usual one in all conditions."""
    if scenario in CYLINDER:
        counts: Sequence[int] = (1,)
    else:
        counts = people if scenario in ("office", "lab") else (1, USUAL_PEOPLE)
    cells = [Cell(scenario, count) for count in counts]
    others = [name for name in CONDITIONS.get(scenario, ()) if name != "as is"]
    return cells + [cell._replace(condition=name) for cell in cells if is_usual(cell) for name in others]


def is_usual(cell: Cell) -> bool:
    """Whether the number of people is the usual one of this scenario."""
    return cell.people == USUAL_PEOPLE or cell.scenario in CYLINDER


def run(cell: Cell, seed: int, setups: Sequence[Setup]) -> Run:
    """Simulates one recording and calibrates it with all setups, each stage once."""
    network = build_network(build_scenario(cell), seed)
    rig, truth = apply_condition(network_rig(network), cell, seed), project_poses(network_truth(network))
    scans = {scanner.name: list(simulate_scans(network, scanner)) for scanner in network.scanners}
    results: dict[Setup, Solved] = {}
    judged = np.zeros((0, 2))
    for feature in sorted({setup.feature for setup in setups}):
        tracked = track_scanners(rig, scans, feature)
        for icp in sorted({setup.icp for setup in setups if setup.feature == feature}):
            rng = np.random.default_rng(seed)
            estimates = estimate_scanner_pairs(tracked, rng, icp=icp, depth_stddev=DEPTH_STDDEV_OF[feature])
            pairs = [pair for pair in estimates.values() if isinstance(pair, ScannerPairEstimate)]
            if feature == "com" and icp:
                judged = np.array([judge(pair, tracked, truth) for pair in pairs]).reshape(-1, 2)
            for setup in (s for s in setups if (s.feature, s.icp) == (feature, icp)):
                results[setup] = solve_poses(rig, tracked, pairs, setup, rng)
    off = {scanner.name: scanner.clock_offset for scanner in network.scanners}
    joint = results.get(JOINT)
    return Run(
        {setup: compute_errors(one, truth) for setup, one in results.items()},
        {setup: compute_nees(one, truth) for setup, one in results.items()},
        joint.offset[1:] - [off[name] for name in joint.names[1:]] if joint else np.zeros(0),
        judged,
    )


def build_scenario(cell: Cell) -> NetworkScenario:
    """The scenario of a recording."""
    parameters: dict[str, Any] = {**SCENARIOS[cell.scenario], "people": {"count": cell.people}}
    if cell.condition == "clocks":
        parameters["scanner"] = {"clock_offset": CLOCKS}
    if cell.condition == "arms":
        parameters["people"]["swing"] = ARMS
    return NetworkScenario(**parameters)


def apply_condition(rig: Rig, cell: Cell, seed: int) -> Rig:
    """The rig with the stated radii of its bodies."""
    if cell.condition != "radii":
        return rig
    target, off = rig.target, SIZES[seed % 2]
    assert isinstance(target, People | Cylinder)
    across, along = target.axes if isinstance(target, People) else (target.diameter / 2, target.diameter / 2)
    return rig.model_copy(update={"target": People(kind="people", axes=(across / off, along / off))})


def track_scanners(
    rig: Rig, scans: Mapping[str, list[LaserScan]], feature: CenterFeature
) -> dict[str, ScannerTracks]:
    """The tracks of each scanner that has any."""
    assert isinstance(rig.target, People | Cylinder)
    tracked: dict[str, ScannerTracks] = {}
    for name, spec in rig.sensors.items():
        assert isinstance(spec, Lidar2dSpec)
        found = track_scanner(
            scans[name],
            rig.target,
            spec.noise,
            centers=select_center_estimator(feature),
            settings=TrackingSettings(),
        )
        if isinstance(found, ScannerTracks):
            tracked[name] = found
    return tracked


def project_poses(truth: GroundTruth) -> dict[str, Array]:
    """T_root_sensor (3, 3) by sensor."""
    in_plane = np.ix_((0, 1, 3), (0, 1, 3))
    return {name: T[in_plane] for name, T in truth.T_root_sensor.items()}


def solve_poses(
    rig: Rig,
    tracked: Mapping[str, ScannerTracks],
    pairs: Sequence[ScannerPairEstimate],
    setup: Setup,
    rng: np.random.Generator,
) -> Solved:
    """Poses of the connected scanners; the published method has one estimate per pair, and rejects none."""
    if setup.average == "consensus":
        sights = {name: ScannerObservations.from_tracks(tracks) for name, tracks in tracked.items()}
        ends = {(pair.sensor_a, pair.sensor_b): pair for pair in pairs}
        sure = initialize_network(rig.root, ends, sights, rng, weighted=setup.weighted)
        graph, names, averaged = sure.graph, sure.names, sure.solution
    else:
        pairs = [replace(pair, hypotheses=pair.hypotheses[:1]) for pair in pairs]
        graph, names = build_network_graph(rig.root, pairs)
        if setup.average == "none":
            averaged = chain_pairs(graph, pairs, names)
        else:
            weights = published_weights(names, pairs) if setup.weighted else None
            averaged, graph = average_network(graph, rng, weights, select_averaging(setup.average))
    if not setup.joint:
        spread = compute_joint_covariance(graph.select_edges(averaged.inliers), averaged.T_root_node)
        return Solved(names, averaged.T_root_node, spread, np.full(len(names), np.nan))
    assert isinstance(rig.target, People | Cylinder)
    joint = solve_network(
        rig.target, [tracked[name] for name in names], averaged, graph, settings=NetworkEstimationSettings()
    )
    return Solved(names, joint.T_root_scanner, joint.pose_covariance, joint.clock_offset)


def chain_pairs(graph: PoseGraph, pairs: Sequence[ScannerPairEstimate], names: Sequence[str]) -> PoseGraphSolution:
    """The pair with the root where there is one, otherwise the fewest and best pairs."""
    costs = np.array([1 + pair.hypotheses[0].cost for pair in pairs if pair.sensor_a in names])
    return PoseGraphSolution(compute_tree_poses(graph, costs[None])[0], np.ones(len(costs), dtype=np.bool_))


def compute_errors(solved: Solved, truth: Mapping[str, Array]) -> Array:
    """(S, 2) degrees and metres of all scanners but the root, NaN without a pose."""
    found = dict(zip(solved.names, solved.T_root_scanner, strict=True))
    nowhere = np.full((3, 3), np.nan)
    others = [name for name in truth if name != solved.names[0]]
    off = np.array([se2.difference(found.get(name, nowhere), truth[name]) for name in others])
    return np.column_stack([np.degrees(np.abs(off[:, 2])), np.hypot(off[:, 0], off[:, 1])])


def compute_nees(solved: Solved, truth: Mapping[str, Array]) -> Array:
    """(S,) normalised estimation errors squared per degree of freedom of all scanners found but the root."""
    off = se2.difference(solved.T_root_scanner, np.array([truth[name] for name in solved.names]))
    blocks = [solved.covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(len(off))]
    return np.array([e @ np.linalg.solve(C, e) / 3 for e, C in zip(off[1:], blocks[1:], strict=True)])


def judge(
    pair: ScannerPairEstimate, tracked: Mapping[str, ScannerTracks], truth: Mapping[str, Array]
) -> tuple[bool, float]:
    """Whether a pair is right, and the RMS distance of simultaneous positions of both scanners, m."""
    true = se2.inverse(truth[pair.sensor_a]) @ truth[pair.sensor_b]
    off = se2.difference(pair.T_a_b, true)
    right = np.degrees(abs(off[2])) < GROSS[0] and np.hypot(off[0], off[1]) < GROSS[1]
    simultaneous = pair_samples(resample_tracks(tracked[pair.sensor_a]), resample_tracks(tracked[pair.sensor_b]))
    squared = np.sum((se2.apply(pair.T_a_b, simultaneous.x_b) - simultaneous.x_a) ** 2, axis=1)
    return bool(right), float(np.sqrt(np.mean(np.minimum.reduceat(squared, simultaneous.run_starts_a))))


def find_gross_errors(errors: Array) -> NDArray[np.bool_]:
    """(S,) whether errors (S, 2) are grossly wrong or missing."""
    return np.asarray(~(errors < np.array(GROSS)).all(axis=1))


@dataclass(frozen=True, eq=False)
class Row:
    """What one setup made of one recording; arrays as of :class:`Run`."""

    scenario: str
    people: int
    condition: Condition
    seed: int
    setups: str
    """All that have it."""
    setup: str
    errors: Array
    nees: Array
    clocks: Array
    pairs: Array

    @property
    def cell(self) -> Cell:
        """The kind of recording."""
        return Cell(self.scenario, self.people, self.condition)


def format_setup(setup: Setup) -> str:
    """A setup in words."""
    return " ".join(map(str, setup))


def measure(scenario: str, people: int, condition: Condition, seed: int, setups: str) -> list[Row]:
    """All setups on one recording."""
    cell = Cell(scenario, people, condition)
    names = {format_setup(setup): setup for setup in setups_of(cell, PRINTED)}
    found = run(cell, seed, [names[name] for name in setups.split("; ")])
    errors, nees = ({name: of[names[name]] for name in setups.split("; ")} for of in (found.errors, found.nees))
    return [Row(*cell, seed, setups, name, errors[name], nees[name], found.clocks, found.pairs) for name in errors]


def setups_of(cell: Cell, tables: Iterable[str]) -> tuple[Setup, ...]:
    """All that the tables want to know of one kind of recording, features by features."""
    if cell.condition != "as is":
        return (PUBLISHED, AVERAGING, JOINT) if "5" in tables else ()
    wanted: set[Setup] = set()
    for table in tables:
        if table == "1" and cell.people == 1:
            wanted.add(PUBLISHED)
        elif table == "2" and cell == Cell("office", USUAL_PEOPLE):
            wanted |= {Setup(f, False, m, False) for f, m in product(FEATURES, get_args(Average))}
        elif table == "3" and is_usual(cell):
            wanted |= {*AVERAGED, *OURS.values()}
        elif table == "4" and cell.scenario == "lab":
            wanted |= {*BY_PEOPLE, *OURS.values()}
        elif table == "5" and is_usual(cell) and cell.scenario in CONDITIONS:
            wanted |= {PUBLISHED, *OURS.values()}
        elif table == "summary":
            wanted |= {*OURS.values()}
    return tuple(sorted(wanted))


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
    print("\nTable III: all scenarios, centre of mass and ICP; ours at the end of each")
    print(f"{'scenario':12}{'weights':10}{'average':11}{HEADER}")
    for cell in filter(is_usual, runs):
        for setup in AVERAGED:
            weights = "weighted" if setup.weighted else "uniform"
            print(f"{cell.scenario:12}{weights:10}{setup.average:11}{summary(runs[cell], setup)}")
        for name, setup in OURS.items():
            print(f"{cell.scenario:12}{'ours: ' + name:21}{summary(runs[cell], setup)}")


def table_4(runs: Runs) -> None:
    """Prints the number of people."""
    print("\nTable IV: number of people, lab, nls without ICP; ours, with ICP, at the end of each")
    print(f"{'people':12}{'average':11}{HEADER}")
    for cell in (cell for cell in runs if cell.scenario == "lab"):
        for setup in BY_PEOPLE:
            print(f"{cell.people:<12d}{setup.average:11}{summary(runs[cell], setup)}")
        for name, setup in OURS.items():
            print(f"{cell.people:<12d}{name:11}{summary(runs[cell], setup)}")


def table_5(runs: Runs) -> None:
    """Prints the published way and ours under all conditions."""
    print("\nTable 5: mean errors, degrees and mm; how many times smaller joint ones are than published ones;")
    print("recordings where joint is worse than published in turn or position; its NEES; RMS error of its clocks")
    heads = ("published", "averaging", "joint", "ratio")
    columns = "".join(f"{head:>16}" for head in heads)
    print(f"{'scenario':10}{'':8}{columns}{'worse':>10}{'nees/3':>8}{'gross':>7}{'ms':>7}")
    for cell, found in runs.items():
        if not is_usual(cell) or cell.scenario not in CONDITIONS:
            continue
        means = {s: mean(np.concatenate([one.errors[s] for one in found])) for s in (PUBLISHED, *OURS.values())}
        shown = "".join(f"{degrees:8.3f}{1000 * metres:8.1f}" for degrees, metres in means.values())
        ratio = means[PUBLISHED] / means[JOINT]
        worse = sum(is_worse(one.errors[JOINT], one.errors[PUBLISHED]) for one in found)
        nees = np.mean(np.concatenate([one.nees[JOINT] for one in found]))
        lost = sum(int(find_gross_errors(one.errors[JOINT]).sum()) for one in found)
        clocks = 1000 * np.sqrt(np.mean(np.concatenate([one.clocks for one in found]) ** 2))
        row = f"{cell.scenario:10}{cell.condition:8}{shown}{ratio[0]:8.1f}{ratio[1]:8.1f}"
        print(f"{row}{f'{worse} of {len(found)}':>10}{nees:8.2f}{lost:7d}{clocks:7.2f}")


def mean(errors: Array) -> Array:
    """(2,) of errors (S, 2) of scanners that have a pose; NaN where none has."""
    placed = errors[np.isfinite(errors).all(axis=1)]
    return np.asarray(placed.mean(axis=0) if len(placed) else np.full(2, np.nan))


def is_worse(errors: Array, others: Array) -> bool:
    """Whether mean errors (S, 2) of one recording are above others in turn or position; none is infinite."""
    mean, other = (np.where(np.isnan(x), np.inf, x).mean(axis=0) for x in (errors, others))
    return bool(np.any(mean > other))


def table_summary(runs: Runs) -> None:
    """Prints accuracy, reliability and consistency of ours."""
    print("\nOurs: errors, recordings without a grossly wrong scanner, squared errors over covariances")
    print(f"{'scenario':12}{'people':8}{'':11}{HEADER}{'clean':>10}{'nees/3':>8}")
    for (cell, found), (name, setup) in product(runs.items(), OURS.items()):
        clean = sum(not find_gross_errors(one.errors[setup]).any() for one in found)
        nees = np.mean(np.concatenate([one.nees[setup] for one in found]))
        row = f"{cell.scenario:12}{cell.people:<8d}{name:11}{summary(found, setup)}"
        print(f"{row}{f'{clean} of {len(found)}':>10}{nees:8.2f}")


HEADER = f"{'mean deg':>10}{'median':>9}{'mean m':>9}{'median':>9}{'gross':>7}{'of':>5}"


def summary(runs: Sequence[Run], setup: Setup) -> str:
    """Mean and median errors of all scanners that have a pose, and how many are grossly wrong or have none."""
    errors = np.concatenate([one.errors[setup] for one in runs])
    (degrees, metres), (middle, halfway) = np.nanmean(errors, axis=0), np.nanmedian(errors, axis=0)
    gross = find_gross_errors(errors).sum()
    return f"{degrees:10.4f}{middle:9.4f}{metres:9.4f}{halfway:9.4f}{gross:7d}{len(errors):5d}"


PRINTED: Mapping[str, Callable[[Runs], None]] = {
    "1": table_1, "2": table_2, "3": table_3, "4": table_4, "5": table_5, "summary": table_summary,
}  # fmt: skip


if __name__ == "__main__":
    main()
