"""Candidates for single legs: short arcs of neighbouring foreground beams.

Clusters of whole bodies merge two legs into one object. Legs need clusters without that merging.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import LegClusterSettings
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


def cluster_legs(beams: Foreground, sigma: float, settings: LegClusterSettings) -> LegClusters:
    """Finds arcs of the size of a leg.

    Args:
        beams: foreground of all scans of a scanner.
        sigma: noise of a range, m.
        settings: of the clusters.
    """
    arcs = _split_arcs(beams, sigma, settings)
    centroid = np.add.reduceat(arcs.points, arcs.first) / arcs.count[:, None]
    distance = np.linalg.norm(centroid, axis=1, keepdims=True)
    # The mean depth of the visible half of a circle is π/4 of its radius in front of the centre.
    centers = centroid * (1 + np.pi / 4 * settings.radius / np.maximum(distance, settings.radius))
    start = beams.times[:1].sum()
    times = np.add.reduceat(beams.times - start, arcs.first) / arcs.count + start
    spread = np.where(arcs.hidden, settings.hidden_center_sigma, settings.center_sigma)
    max_width = settings.max_width + settings.max_gap_sigmas * sigma
    chosen = (arcs.count >= settings.min_beams) & (arcs.width >= settings.min_width) & (arcs.width <= max_width)
    return LegClusters(centers[chosen], times[chosen], beams.scan[arcs.first][chosen], spread[chosen])


def measure_widths(beams: Foreground, sigma: float, settings: LegClusterSettings) -> Array:
    """Widths of the objects that nothing hides and that have enough beams for a width, m."""
    arcs = _split_arcs(beams, sigma, settings)
    return arcs.width[~arcs.hidden & (arcs.count >= settings.min_width_beams)]


def _split_arcs(beams: Foreground, sigma: float, settings: LegClusterSettings) -> _Arcs:
    points = beams.ranges[:, None] * np.stack([np.cos(beams.angles), np.sin(beams.angles)], axis=-1)
    if not len(points):
        nothing = np.empty(0, dtype=np.intp)
        return _Arcs(points, nothing, nothing, np.empty(0), np.empty(0, dtype=np.bool_))
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    apart = (np.diff(beams.scan) != 0) | (np.diff(beams.beam) > 1)
    apart |= step > settings.max_gap + settings.max_gap_sigmas * sigma
    first = np.concatenate([[0], np.flatnonzero(apart) + 1])
    count = np.diff(first, append=len(points))
    last = first + count - 1
    extent = np.maximum.reduceat(points, first) - np.minimum.reduceat(points, first)
    width = np.hypot(extent[:, 0], extent[:, 1])
    return _Arcs(points, first, count, width, beams.at_occlusion[first] | beams.at_occlusion[last])
