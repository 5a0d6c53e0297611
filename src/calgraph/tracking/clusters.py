"""Objects in the foreground of scans: neighbouring beams that end before the static surroundings."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from calgraph.geometry import Array
from calgraph.tracking.scan_stack import ScanRun
from calgraph.tracking.static_scene import StaticScene

# Neighbouring points belong to one surface up to this distance: m, and as a multiple of the beam spacing.
_GAP = (0.12, 2.5)
# Beams without a measurement within a surface.
_MISSING = 2
# Parts up to this width together, of the target's, are one object: two legs, or both sides of an occluder.
_MERGED = 1.4
# Nothing wider than this is one target.
_WIDEST = 1.8
_FEWEST = 2


@dataclass(frozen=True, eq=False)
class Clusters:
    """All objects in all scans of a recording; their points lie one after the other, cluster by cluster."""

    points: Array
    """(P, 2) sensor frame, m."""
    owner: NDArray[np.intp]
    """(P,) cluster of each point, ascending."""
    first: NDArray[np.intp]
    """(C,) index of each cluster's first point."""
    count: NDArray[np.intp]
    """(C,) points of each cluster."""
    scan: NDArray[np.intp]
    """(C,) the scan of each cluster, ascending."""
    times: Array
    """(C,) mean time of the cluster's beams, s."""
    point_times: Array
    """(P,) when each point was measured, s."""
    spacing: Array
    """(C,) angle between neighbouring beams, rad."""
    clipped: NDArray[np.bool_]
    """(C,) whether something nearer, or the end of the field of view, hides a part of the object."""

    def __len__(self) -> int:
        return len(self.first)

    def sums(self, values: Array) -> Array:
        """Sums over each cluster's points of ``values`` (P, ...): (C, ...)."""
        return np.add.reduceat(values, self.first, axis=0) if len(self) else values[:0]

    @property
    def means(self) -> Array:
        """(C, 2) centres of mass, m."""
        return self.sums(self.points) / self.count[:, None]


@dataclass(frozen=True, eq=False)
class Foreground:
    """The beams of many scans that end before the static surroundings, in order of scan and beam."""

    scan: NDArray[np.intp]
    """(P,) index of the scan."""
    beam: NDArray[np.intp]
    """(P,) index of the beam in its scan."""
    angles: Array
    """(P,) rad."""
    ranges: Array
    """(P,) m."""
    times: Array
    """(P,) when the beam was measured, s."""
    hidden: NDArray[np.bool_]
    """(P,) whether the beam before or after it is missing from the scan, or ends nearer."""
    spacing: Array
    """(S,) angle between neighbouring beams of each scan, rad."""


def foreground(runs: Sequence[ScanRun], scene: StaticScene) -> Foreground:
    """Subtracts the static surroundings."""
    before = np.cumsum([0, *map(len, runs)])
    nothing = ScanRun(np.empty(0), np.empty(0), np.empty(0), np.empty((0, 0)))
    parts = [_new_beams(run, scene, int(first)) for run, first in zip((*runs, nothing), before, strict=True)]
    return Foreground(
        np.concatenate([part.scan for part in parts]),
        np.concatenate([part.beam for part in parts]),
        np.concatenate([part.angles for part in parts]),
        np.concatenate([part.ranges for part in parts]),
        np.concatenate([part.times for part in parts]),
        np.concatenate([part.hidden for part in parts]),
        np.concatenate([part.spacing for part in parts]),
    )


def _new_beams(run: ScanRun, scene: StaticScene, first: int) -> Foreground:
    """The foreground of successive scans, of which the first has this index."""
    scan, beam = np.nonzero(scene.nearer.is_foreground(run.angles, run.ranges))
    turn = abs(run.angles[-1] - run.angles[0]) if len(run.angles) > 1 else 0.0
    spacing = turn / max(len(run.angles) - 1, 1)
    ranges = run.ranges[scan, beam]
    # Two beams to either side, for the one at an edge often ends in between or nowhere.
    beside = beam[:, None] + np.array([-2, -1, 1, 2])
    outside = (beside < 0) | (beside >= len(run.angles))
    nearer = run.ranges[scan[:, None], np.clip(beside, 0, len(run.angles) - 1)]
    # NaN, no measurement, is not nearer.
    hidden = outside | (nearer < (ranges * (1 - _GAP[1] * spacing) - _GAP[0])[:, None])
    return Foreground(
        first + scan, beam, run.angles[beam], ranges,
        np.asarray(run.stamps[scan] + beam * run.increments[scan]), hidden.any(axis=1), np.full(len(run), spacing),
    )  # fmt: skip


def clusters(seen: Foreground, width: float, sigma: float) -> Clusters:
    """Groups foreground beams to objects.

    Args:
        seen: the foreground of all scans.
        width: largest width of the target, m.
        sigma: noise of a range, m.

    Returns:
        Objects of at least two beams that are not clearly wider than the target.
    """
    points = seen.ranges[:, None] * np.stack([np.cos(seen.angles), np.sin(seen.angles)], axis=-1)
    if not len(points):
        return _gathered(seen, points, np.empty(0, dtype=np.intp), width)
    step = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    allowed = _GAP[0] + 3 * sigma + _GAP[1] * seen.ranges[1:] * seen.spacing[seen.scan[1:]]
    apart = (np.diff(seen.scan) != 0) | (np.diff(seen.beam) > 1 + _MISSING) | (step > allowed)
    part = np.concatenate([[0], np.cumsum(apart)])
    return _gathered(seen, points, _merged(seen, points, part, _MERGED * width + 2 * sigma), width)


def _merged(seen: Foreground, points: Array, part: NDArray[np.intp], width: float) -> NDArray[np.intp]:
    """(P,) labels after joining parts of one scan whose points lie within ``width``, m, all together."""
    first = np.flatnonzero(np.diff(part, prepend=-1))
    scan = seen.scan[first]
    low, high = np.minimum.reduceat(points, first), np.maximum.reduceat(points, first)
    links: list[NDArray[np.intp]] = []
    # Beyond the next but one, parts are of other objects.
    for apart in (1, 2):
        i = np.arange(len(first) - apart)
        j = i + apart
        extent = np.maximum(high[i], high[j]) - np.minimum(low[i], low[j])
        near = (scan[i] == scan[j]) & (np.hypot(extent[:, 0], extent[:, 1]) < width)
        links.append(np.stack([i[near], j[near]]))
    i, j = np.concatenate(links, axis=1)
    graph = coo_matrix((np.ones(len(i)), (i, j)), shape=(len(first), len(first)))
    return np.asarray(connected_components(graph, directed=False)[1][part], dtype=np.intp)


def _gathered(seen: Foreground, points: Array, label: NDArray[np.intp], width: float) -> Clusters:
    """Points sorted by cluster, without the clusters that are no targets."""
    order = np.lexsort((label, seen.scan))
    owner = np.cumsum(np.diff(label[order], prepend=-1) != 0) - 1
    first = np.flatnonzero(np.diff(owner, prepend=-1))
    count = np.diff(first, append=len(owner))
    if len(first):
        extent = np.maximum.reduceat(points[order], first) - np.minimum.reduceat(points[order], first)
        good = (np.hypot(extent[:, 0], extent[:, 1]) <= _WIDEST * width) & (count >= _FEWEST)
        order = order[np.repeat(good, count)]
        count = count[good]
        first = np.cumsum(count) - count
        owner = np.repeat(np.arange(len(count)), count)
    # The outermost beams alone say whether an object goes on beside them.
    last = first + count - 1
    hidden = seen.hidden[order]
    scan = seen.scan[order][first]
    total = np.add.reduceat(seen.times[order] - seen.times[:1], first) if len(first) else np.empty(0)
    return Clusters(
        points[order], owner, first, count, scan,
        total / count + (seen.times[0] if len(seen.times) else 0.0), seen.times[order],
        seen.spacing[scan] if len(scan) else np.empty(0), hidden[first] | hidden[last],
    )  # fmt: skip
