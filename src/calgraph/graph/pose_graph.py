"""Graphs of relative poses with outliers, in the plane or in space, and their solutions."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import CalibrationError
from calgraph.geometry import Array, se_n
from calgraph.solver.connected_parts import label_parts

Edges = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Relative poses between nodes; several edges of one pair are alternatives, at most one of which is right."""

    count: int
    """Nodes are 0 ... count - 1."""
    edges: Edges
    """(E, 2) nodes i, j."""
    T_i_j: Array
    """(E, n+1, n+1), n = 2 or 3."""
    information: Array
    """(E, d, d), d = 3 or 6: inverse covariance of T_i_j's error in the fixed axes of i, translation first."""
    root: int = 0
    """The node whose frame poses are expressed in."""

    @property
    def dimension(self) -> int:
        """2 in the plane, 3 in space."""
        return int(self.T_i_j.shape[-1] - 1)

    @property
    def R_i_j(self) -> Array:
        """(E, n, n)."""
        return se_n.rotation(self.T_i_j)

    @cached_property
    def pair_of_edge(self) -> NDArray[np.intp]:
        """(E,) index of each edge's pair of nodes, the same for alternatives, in either direction."""
        ordered = np.sort(self.edges, axis=1)
        return np.asarray(
            np.unique(ordered[:, 0] * self.count + ordered[:, 1], return_inverse=True)[1], dtype=np.intp
        )

    def find_reachable(self) -> NDArray[np.bool_]:
        """(N,) whether some chain of edges connects a node to the root."""
        labels = label_parts(self.count, self.edges)
        return np.asarray(labels == labels[self.root], dtype=np.bool_)

    def require_connected(self) -> None:
        """Raises CalibrationError, naming the nodes, if some are not connected to the root."""
        missing = np.flatnonzero(~self.find_reachable())
        if len(missing):
            names = ", ".join(map(str, missing[:10])) + (" ..." if len(missing) > 10 else "")
            raise CalibrationError(
                f"graph: no chain of edges connects nodes {names} to node {self.root};"
                " leave them out, or add pairs that reach them"
            )

    def select_edges(self, keep: NDArray[np.bool_] | NDArray[np.intp]) -> "PoseGraph":
        """The graph of some of its edges, by a mask (E,) or by index, between the same nodes."""
        return PoseGraph(self.count, self.edges[keep], self.T_i_j[keep], self.information[keep], self.root)

    def with_error_floor(self, position: float, angle: float) -> "PoseGraph":
        """The graph with a model error (standard deviations, m and rad) added to the covariance of every edge.

        Consensus rejects edges whose errors exceed their covariance, which is often optimistic. Directions that an
        edge does not observe, with singular information, stay unobserved.
        """
        n, dof = self.dimension, self.information.shape[-1]
        floor = np.diag([position**2] * n + [angle**2] * (dof - n))
        # (I + information · floor)⁻¹ information is (information⁻¹ + floor)⁻¹, without inverting what is singular.
        inflated = np.linalg.solve(np.eye(dof) + self.information @ floor, self.information)
        information = (inflated + np.swapaxes(inflated, -1, -2)) / 2
        return PoseGraph(self.count, self.edges, self.T_i_j, information, self.root)


@dataclass(frozen=True, eq=False)
class PoseGraphSolution:
    """Node poses, and the edges that agree with them."""

    T_root_node: Array
    """(N, n+1, n+1)."""
    inliers: NDArray[np.bool_]
    """(E,) the edges that agree with the poses, at most one of a pair."""


PoseAveraging = Callable[[PoseGraph, Array | None], PoseGraphSolution]
"""From a connected graph and the weights (E,) of its edges to poses; None for uniform weights."""


def residuals(graph: PoseGraph, T_root_node: Array) -> Array:
    """Errors (..., E, d) of the predicted relative poses for node poses (..., N, n+1, n+1), in i's fixed axes."""
    i, j = graph.edges.T
    predicted = se_n.inverse(T_root_node[..., i, :, :]) @ T_root_node[..., j, :, :]
    return se_n.difference(predicted, graph.T_i_j)


def chi_squared(graph: PoseGraph, T_root_node: Array) -> Array:
    """Squared Mahalanobis distances (..., E) of the edges to node poses (..., N, n+1, n+1)."""
    r = residuals(graph, T_root_node)
    return np.asarray(np.sum(r * (graph.information @ r[..., None])[..., 0], axis=-1))
