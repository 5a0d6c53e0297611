"""The minimum spanning tree of a rig's pairs: which sensors are connected to the root, and start poses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.config.settings import BoardPairSettings
from calgraph.geometry import Array
from calgraph.graph.pairwise_estimate import PairwiseEstimate


@dataclass(frozen=True, eq=False)
class SpanningTree:
    """A tree of sensors with the start pose of each."""

    root: str
    parents: Mapping[str, str]
    """Parent of every connected sensor but the root, parents before their children."""
    T_root_sensor: Mapping[str, Array]
    """Start pose (4, 4) of every connected sensor, the root included."""

    def has_edge(self, a: str, b: str) -> bool:
        """Whether one of the two sensors is the parent of the other."""
        return self.parents.get(a) == b or self.parents.get(b) == a


def find_spanning_tree(
    root: str, estimates: Sequence[PairwiseEstimate], max_stddev: float = BoardPairSettings().max_stddev
) -> SpanningTree:
    """Grows the minimum spanning tree from the root (Prim), by summed squared error (MSG-Cal, V).

    Pairs with an unobserved direction are used only where no other pair reaches a sensor.

    Args:
        root: name of the root sensor.
        estimates: pairwise estimates; at most one for each pair.
        max_stddev: a pair does not observe directions of a larger standard deviation, m and rad.

    Returns:
        The tree of all sensors that are connected to the root.
    """
    return grow_tree(SpanningTree(root, {}, {root: np.eye(4)}), estimates, max_stddev)


def grow_tree(
    tree: SpanningTree, estimates: Sequence[PairwiseEstimate], max_stddev: float = BoardPairSettings().max_stddev
) -> SpanningTree:
    """The tree with all sensors that estimates connect to it, extended as :func:`find_spanning_tree` does."""
    poses, parents = dict(tree.T_root_sensor), dict(tree.parents)
    directed = [*estimates, *(e.inverse() for e in estimates)]
    while True:
        leaving = [e for e in directed if e.sensor_a in poses and e.sensor_b not in poses]
        if not leaving:
            return SpanningTree(tree.root, parents, poses)
        best = min(leaving, key=lambda e: (unobservable_stddev(e, max_stddev), e.squared_error))
        parents[best.sensor_b] = best.sensor_a
        poses[best.sensor_b] = poses[best.sensor_a] @ best.T_a_b


def unobservable_stddev(estimate: PairwiseEstimate, max_stddev: float) -> float:
    """Standard deviation (m or rad) along the weakest direction if that is unobserved; 0 otherwise."""
    # Zero information would have no finite weight.
    weakest = max(float(np.linalg.eigvalsh(estimate.information)[0]), 1e-12)
    return 0.0 if weakest >= max_stddev**-2 else weakest**-0.5
