"""How often each graph method finds all sensors, by the share of wrong edges.

Graphs join every pair of 6 to 8 sensors in a 10 m square, edges have 0.7° and 5 cm of noise, and wrong ones are
anywhere, turned anyhow. A sensor is found if it is within 0.5 m and 5°.

No method can determine which of a sensor's edges is right if only one is and others disagree: a graph is
*decidable* if its right edges still connect all sensors without any one of them. Success is given over all graphs
and over those.

Rotation methods are followed by least-squares translations over the edges whose rotation they agree with.

    python benchmarks/graph_methods.py --seeds 200
"""

import time
from typing import get_args

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from calgraph.geometry import Array, se_n
from calgraph.graph.averaging import RotationAveraging, average_poses_by_rotations
from calgraph.graph.pose_graph import PoseGraph
from calgraph.graph.tree_consensus import average_poses
from worlds import make_parser

POSITION, ANGLE = 0.05, np.radians(0.7)
NEAR, TURNED = 0.5, np.radians(5)


def random_graph(
    count: int, edges: int, n: int, wrong: float, size: float, rng: np.random.Generator
) -> tuple[PoseGraph, Array, NDArray[np.bool_]]:
    """A connected random graph, its true poses in the frame of node 0, and which edges are wrong."""
    T = random_poses(count, n, size, rng)
    T = se_n.inverse(T[0]) @ T
    pairs = random_pairs(count, edges, rng)
    sigma = np.array([POSITION] * n + [ANGLE] * (1 if n == 2 else 3))
    T_i_j = se_n.inverse(T[pairs[:, 0]]) @ T[pairs[:, 1]]
    T_i_j = se_n.retract(T_i_j, sigma * rng.normal(size=(edges, len(sigma))))
    bad = rng.permutation(edges) < round(wrong * edges)
    T_i_j[bad] = random_poses(int(bad.sum()), n, size, rng)
    return PoseGraph(count, pairs, T_i_j, np.tile(np.diag(sigma**-2), (edges, 1, 1))), T, bad


def random_poses(count: int, n: int, size: float, rng: np.random.Generator) -> Array:
    """Poses anywhere in a square or cube."""
    return se_n.pose(
        se_n.nearest_rotation(rng.normal(size=(count, n, n))), rng.uniform(-size / 2, size / 2, (count, n))
    )


def random_pairs(count: int, edges: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """A random tree and further random pairs, none twice."""
    first = np.arange(1, count)
    tree = np.column_stack([first, (rng.random(count - 1) * first).astype(np.intp)])
    others = np.column_stack(np.triu_indices(count, 1))
    taken = set(map(tuple, np.sort(tree, axis=1).tolist()))
    free = [pair for pair in others[rng.permutation(len(others))].tolist() if tuple(pair) not in taken]
    return np.concatenate([tree, np.array(free[: edges - len(tree)], dtype=np.intp).reshape(-1, 2)])


def decidable(graph: PoseGraph, wrong: NDArray[np.bool_]) -> bool:
    """Whether the right edges connect all nodes, even without any one of them."""
    everyone = np.arange(len(wrong))
    kept = [~wrong, *(~wrong & (everyone != e) for e in np.flatnonzero(~wrong))]
    return all(graph.select_edges(right).find_reachable().all() for right in kept)


def found(T_est: Array, T: Array) -> tuple[bool, bool]:
    """Whether all rotations are right, and whether all poses are."""
    n = T.shape[-1] - 1
    error = se_n.difference(T_est, T)
    turned = np.linalg.norm(error[:, n:], axis=1)
    off = np.linalg.norm(error[:, :n], axis=1)
    return bool((turned < TURNED).all()), bool((turned < TURNED).all() and (off < NEAR).all())


def interval(successes: NDArray[np.bool_]) -> str:
    """A success rate with its 95 % confidence interval (Clopper–Pearson)."""
    if not len(successes):
        return "-"
    of = binomtest(int(successes.sum()), len(successes)).proportion_ci(method="exact")
    return f"{successes.mean():.3f} ({of.low:.2f}-{of.high:.2f})"


def table(n: int, seeds: int) -> None:
    """Prints success rates of all methods."""
    print(f"SE({n}), complete graphs of 6-8 sensors, {seeds} seeds; in brackets 95 % confidence")
    titles = ("wrong", "method", "rotations, all", "poses, all", "poses, decidable", "of", "CPU ms")
    row = "{:>5}  {:16}{:20}{:20}{:20}{:>4}{:>9}"
    print(row.format(*titles))
    for wrong in (0.2, 0.3, 0.4, 0.5):
        graphs = []
        for seed in range(seeds):
            rng = np.random.default_rng([n, round(100 * wrong), seed])
            count = int(rng.integers(6, 9))
            graphs.append(random_graph(count, count * (count - 1) // 2, n, wrong, 10.0, rng))
        clear = np.array([decidable(graph, bad) for graph, _, bad in graphs])
        for method in ("consensus", *get_args(RotationAveraging)):
            start = time.process_time()
            poses = [
                (
                    average_poses(graph, np.random.default_rng(seed))
                    if method == "consensus"
                    else average_poses_by_rotations(graph, None, method)
                ).T_root_node
                for seed, (graph, _, _) in enumerate(graphs)
            ]
            each = 1000 * (time.process_time() - start) / seeds
            ok = np.array([found(T_est, T) for T_est, (_, T, _) in zip(poses, graphs, strict=True)])
            rates = interval(ok[:, 0]), interval(ok[:, 1]), interval(ok[clear, 1])
            print(row.format(f"{wrong:.0%}", method, *rates, clear.sum(), f"{each:.1f}"), flush=True)


def main() -> None:
    """Prints everything."""
    parser = make_parser(__doc__)
    parser.add_argument("--seeds", type=int, default=200, help="graphs for each share of wrong edges")
    parser.add_argument("--dimensions", type=int, nargs="+", default=[2, 3], choices=[2, 3])
    options = parser.parse_args()
    for n in options.dimensions:
        table(n, options.seeds)


if __name__ == "__main__":
    main()
