"""Random pose graphs with and without outliers, for the tests of averaging."""

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se_n
from calgraph.graph.pose_graph import PoseGraph

POSITION, ANGLE = 0.05, np.radians(0.7)


def random_poses(count: int, n: int, rng: np.random.Generator, size: float = 10.0) -> Array:
    """Poses all over a square or cube of the edge given, m, turned anyhow."""
    R = se_n.nearest_rotation(rng.normal(size=(count, n, n)))
    return se_n.pose(R, rng.uniform(-size / 2, size / 2, (count, n)))


def true_poses(count: int, n: int, rng: np.random.Generator, size: float = 10.0) -> Array:
    """Random node poses in the frame of node 0."""
    T = random_poses(count, n, rng, size)
    return np.asarray(se_n.inverse(T[0]) @ T)


def measured(
    T: Array, edges: list[tuple[int, int]] | NDArray[np.intp], rng: np.random.Generator, noise: float = 0.0
) -> PoseGraph:
    """A graph of relative poses, with so many times 5 cm and 0.7° of noise."""
    e = np.array(edges, dtype=np.intp)
    n = T.shape[-1] - 1
    sigma = np.array([POSITION] * n + [ANGLE] * (1 if n == 2 else 3))
    T_i_j = se_n.inverse(T[e[:, 0]]) @ T[e[:, 1]]
    T_i_j = se_n.retract(T_i_j, noise * sigma * rng.normal(size=(len(e), len(sigma))))
    return PoseGraph(len(T), e, T_i_j, np.tile(np.diag(sigma**-2), (len(e), 1, 1)))


def with_wrong(graph: PoseGraph, wrong: list[int], rng: np.random.Generator) -> PoseGraph:
    """The graph with anything instead of some of its edges."""
    T_i_j = graph.T_i_j.copy()
    T_i_j[wrong] = random_poses(len(wrong), graph.dimension, rng)
    return PoseGraph(graph.count, graph.edges, T_i_j, graph.information, graph.root)


def ring(count: int) -> list[tuple[int, int]]:
    return [(k, (k + 1) % count) for k in range(count)]


def complete(count: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(count) for j in range(i + 1, count)]


# A hub in the middle of a ring of eight: triangles side by side, all around.
WHEEL = [(0, k) for k in range(1, 9)] + [(k, k % 8 + 1) for k in range(1, 9)]
