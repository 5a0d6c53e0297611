"""Figure 5 (a–d) of MSG-Cal as tables: pairwise against global, filtered against unfiltered.

    python benchmarks/msg_cal.py --seeds 20

``pairwise`` are the paper's pairs along the spanning tree, ``global`` its hypergraph; ``default`` is what calgraph
does: pairs polished on their inliers, then the bundle.

Each seed is another robot, room and walk of 120 captures, a tenth of them disturbed as on a real robot, where
operators slip. Errors are means over the sensors; tables give mean and standard deviation over the seeds.
"""

from typing import NamedTuple

import numpy as np

from calgraph.config.settings import BoardPairSettings, Settings
from calgraph.geometry import Array
from calgraph.rig.options import RigOptions
from calgraph.rig.pairs.board_pair import estimate_pairs, select_successful
from calgraph.rig.pairs.rig_initialization import initialize_rig
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.rig.published.hypergraph import HypergraphSolution, solve_hypergraph
from calgraph.simulation import RigScenario
from simulated_captures import detected, errors, poses_of
from worlds import NAN, make_parser, run_worlds

VARIANTS = ("pairwise", "global", "global, from identity", "global, unfiltered", "default")


class Row(NamedTuple):
    """Mean errors of a variant over the sensors."""

    disturbed: float
    seed: int
    variant: str
    metres: float
    degrees: float
    graph_error: float
    """m²."""


def main() -> None:
    """Prints the four tables."""
    parser = make_parser(__doc__, jobs=1)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--disturbed", type=float, default=0.1)
    arguments = parser.parse_args()
    scenario = RigScenario(samples=5, disturbed=arguments.disturbed)
    print(f"{arguments.seeds} seeds of {scenario.captures} captures, {arguments.disturbed:.0%} disturbed")
    work = [(arguments.disturbed, seed) for seed in range(arguments.seeds)]
    rows = run_worlds(Row, measure, work, arguments, key=2)
    table = {name: np.array([row[3:] for row in rows if row.variant == name]) for name in VARIANTS}
    show("(a) mean translation error, mm", table, ("pairwise", "global"), 0, 1000)
    show("(b) graph error, m²", table, ("pairwise", "global"), 2, 1)
    show("(c) graph error, m²", table, ("global", "global, unfiltered"), 2, 1)
    show("(d) mean rotation error, degrees", table, ("pairwise", "global"), 1, 1)
    print("Other comparisons of section VII")
    others = ("global, from identity", "global, unfiltered", "default")
    show("    translation error, mm", table, others, 0, 1000)
    show("    rotation error, degrees", table, others, 1, 1)


def measure(disturbed: float, seed: int) -> list[Row]:
    """All variants of one seed."""
    found = run(RigScenario(samples=5, disturbed=disturbed), seed)
    return [Row(disturbed, seed, variant, *figures) for variant, figures in found.items()]


def run(scenario: RigScenario, seed: int) -> dict[str, tuple[float, float, float]]:
    """Mean translation (m) and rotation (degrees) error and graph error (m²) of each variant."""
    rig, captured, truth = detected(scenario, seed)
    seen, rng = captured.detections, np.random.default_rng(seed)
    estimates = select_successful(
        estimate_pairs(seen, rig.board_size, rng, refine=False, settings=BoardPairSettings())
    )
    tree = initialize_rig(rig.root, estimates, "tree", rng)
    at_root = initialize_rig(rig.root, estimates, "identity", rng)

    def judge(joint: HypergraphSolution) -> tuple[float, float, float]:
        metres, degrees = errors(dict(joint.T_root_sensor), truth)
        return float(metres.mean()), float(degrees.mean()), joint.graph_error

    calibration = solve_problem(
        build_problem_from_captures(rig, captured, RigOptions(), np.random.default_rng(seed))
    )
    metres, degrees = errors(poses_of(calibration), truth)
    return {
        "default": (float(metres.mean()), float(degrees.mean()), NAN),
        "pairwise": judge(solve_hypergraph(tree, estimates, seen, optimize=False, settings=Settings())),
        "global": judge(solve_hypergraph(tree, estimates, seen, settings=Settings())),
        "global, from identity": judge(solve_hypergraph(at_root, estimates, seen, settings=Settings())),
        "global, unfiltered": judge(solve_hypergraph(tree, estimates, seen, keep="none", settings=Settings())),
    }


def show(title: str, table: dict[str, Array], names: tuple[str, ...], column: int, scale: float) -> None:
    """Prints mean, standard deviation, median, smallest and largest of one figure."""
    print(f"\n{title}\n{'':24}{'mean':>10}{'std':>10}{'median':>10}{'min':>10}{'max':>10}")
    for name in names:
        v = scale * table[name][:, column]
        print(f"{name:24}{v.mean():10.4f}{v.std():10.4f}{np.median(v):10.4f}{v.min():10.4f}{v.max():10.4f}")


if __name__ == "__main__":
    main()
