"""Candidates for single legs: short arcs of neighbouring foreground beams.

Clusters of whole bodies merge two legs into one object. Legs need clusters without that merging.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index
from calgraph.network.tracking.clusters import Foreground


@dataclass(frozen=True, eq=False)
class LegClusters:
    """Arcs of the size of a leg in all scans of one scanner, in order of scan."""

    centers: Array
    """(C, 2) approximate centres of the legs, sensor frame, m."""
    times: Array
    """(C,) mean time of their beams, s."""
    scan: Index
    """(C,) ascending."""
    sigma: Array
    """(C,) standard deviation of a centre along each axis, m."""


@dataclass(frozen=True, eq=False)
class _Arcs:
    """Neighbouring foreground beams on one surface."""

    points: Array
    """(P, 2) end points of all beams, sensor frame, m."""
    first: Index
    """(A,) index of each arc's first point."""
    count: Index
    """(A,) points of each arc."""
    width: Array
    """(A,) diagonal of the points' extent, m."""
    hidden: NDArray[np.bool_]
    """(A,) whether a nearer surface hides a part of the object."""


# Radius of a leg, m: of shins at 0.3 m height.
_RADIUS = 0.065
# The same where another surface hides a part of the leg: a radius.
_HIDDEN_CENTER_SIGMA = 0.06
# Standard deviation of the centre of a cluster along each axis, m: half of a leg's radius.
_CENTER_SIGMA = 0.03
# Maximum diagonal of a cluster, m: a shin of 18 cm depth, which is visible from its side.
_MAX_WIDTH = 0.25
# The same in standard deviations of a range, also added to the greatest width.
_MAX_GAP_SIGMAS = 3.0
# Minimum number of beams: single ones are often mixed pixels between a leg and the background. With three, coarse
# scanners (0.5°) lose legs from 7 m on.
_MIN_BEAMS = 2
# Minimum diagonal of a cluster, m: two beams of a coarse scanner 4 m away.
_MIN_WIDTH = 0.03


def cluster_legs(beams: Foreground, sigma: float) -> LegClusters:
    """Finds arcs of the size of a leg.

    Args:
        beams: foreground of all scans of a scanner.
        sigma: noise of a range, m.
    """
    arcs = _split_arcs(beams, sigma)
    centroid = np.add.reduceat(arcs.points, arcs.first) / arcs.count[:, None]
    distance = np.linalg.norm(centroid, axis=1, keepdims=True)
    # The mean depth of the visible half of a circle is π/4 of its radius in front of the centre.
    centers = centroid * (1 + np.pi / 4 * _RADIUS / np.maximum(distance, _RADIUS))
    start = beams.times[:1].sum()
    times = np.add.reduceat(beams.times - start, arcs.first) / arcs.count + start
    spread = np.where(arcs.hidden, _HIDDEN_CENTER_SIGMA, _CENTER_SIGMA)
    max_width = _MAX_WIDTH + _MAX_GAP_SIGMAS * sigma
    chosen = (arcs.count >= _MIN_BEAMS) & (arcs.width >= _MIN_WIDTH) & (arcs.width <= max_width)
    return LegClusters(centers[chosen], times[chosen], beams.scan[arcs.first][chosen], spread[chosen])


# Minimum number of beams of an object whose width counts in the choice between legs and bodies: the width of four
# is short by a quarter at most.
_MIN_WIDTH_BEAMS = 4


def measure_widths(beams: Foreground, sigma: float) -> Array:
    """Widths of the objects that nothing hides and that have enough beams for a width, m."""
    arcs = _split_arcs(beams, sigma)
    return arcs.width[~arcs.hidden & (arcs.count >= _MIN_WIDTH_BEAMS)]


# Neighbouring points on one leg are at most this far apart, m: beams at 60° to a shin 5 m away end 6 cm apart.
_MAX_GAP = 0.1


def _split_arcs(beams: Foreground, sigma: float) -> _Arcs:
    points = beams.ranges[:, None] * beams.direction
    if not len(points):
        nothing = np.empty(0, dtype=np.intp)
        return _Arcs(points, nothing, nothing, np.empty(0), np.empty(0, dtype=np.bool_))
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    apart = (np.diff(beams.scan) != 0) | (np.diff(beams.beam) > 1)
    apart |= step > _MAX_GAP + _MAX_GAP_SIGMAS * sigma
    first = np.concatenate([[0], np.flatnonzero(apart) + 1])
    count = np.diff(first, append=len(points))
    last = first + count - 1
    extent = np.maximum.reduceat(points, first) - np.minimum.reduceat(points, first)
    width = np.hypot(extent[:, 0], extent[:, 1])
    return _Arcs(points, first, count, width, beams.at_occlusion[first] | beams.at_occlusion[last])
