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
from dataclasses import dataclass
from itertools import product
from typing import get_args

import numpy as np

from calgraph.geometry import Array
from network_runs import (
    AVERAGING,
    CONDITIONS,
    FEATURES,
    JOINT,
    OURS,
    PUBLISHED,
    SCENARIOS,
    USUAL_PEOPLE,
    Average,
    Cell,
    Condition,
    Run,
    Setup,
    find_gross_errors,
    is_usual,
    list_cells,
    run,
)  # fmt: skip
from worlds import grouped, make_parser, run_worlds

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
    return [
        Row(
            *cell,
            seed,
            setups,
            name,
            found.errors[names[name]],
            found.nees[names[name]],
            found.clocks,
            found.pairs,
        )
        for name in setups.split("; ")
    ]


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
