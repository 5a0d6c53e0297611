"""Connected parts of a graph."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from calgraph.geometry import Index


def label_parts(count: int, ends: Index) -> Index:
    """(N,) number of the part of each of ``count`` nodes, those that chains of edges (E, 2) connect."""
    adjacency = coo_array((np.ones(len(ends)), ends.T), shape=(count, count))
    return np.asarray(connected_components(adjacency, directed=False)[1], dtype=np.intp)
