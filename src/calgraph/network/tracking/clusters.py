"""Objects in the foreground of scans: neighbouring beams that end before the static background."""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import ClusterSettings
from calgraph.geometry import Array
from calgraph.network.tracking.scan_stack import SCANS_PER_CALL, RangeFile, ScanRun
from calgraph.network.tracking.static_scene import StaticScene
from calgraph.solver.connected_parts import label_parts


@dataclass(frozen=True, eq=False)
class Clusters:
    """All objects in all scans of a recording; points are ordered by cluster."""

    points: Array
    """(P, 2) sensor frame, m."""
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
    """(C,) whether a nearer surface, or the end of the field of view, hides a part of the object."""

    def __len__(self) -> int:
        return len(self.first)

    @property
    def centroids(self) -> Array:
        """(C, 2) centres of mass, m."""
        sums = np.add.reduceat(self.points, self.first, axis=0) if len(self) else self.points[:0]
        return sums / self.count[:, None]


@dataclass(frozen=True, eq=False)
class Foreground:
    """The beams of many scans that end before the static background, in order of scan and beam."""

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
    at_occlusion: NDArray[np.bool_]
    """(P,) whether the beam before or after it is missing from the scan, or ends nearer."""
    spacing: Array
    """(S,) angle between neighbouring beams of each scan, rad."""

    @property
    def direction(self) -> Array:
        """(P, 2) unit vectors, sensor frame."""
        return np.stack([np.cos(self.angles), np.sin(self.angles)], axis=-1)

    def select(self, rows: NDArray[np.bool_] | NDArray[np.intp] | slice) -> "Foreground":
        """Some of the beams (P,), of the same scans."""
        return Foreground(
            self.scan[rows], self.beam[rows], self.angles[rows], self.ranges[rows], self.times[rows],
            self.at_occlusion[rows], self.spacing,
        )  # fmt: skip


def subtract_background(runs: Sequence[ScanRun], scene: StaticScene) -> Foreground:
    """Keeps the beams that end before the static background."""
    before = np.cumsum([0, *map(len, runs)])
    empty_run = ScanRun(np.empty(0), np.empty(0), np.empty(0), RangeFile(), np.empty((0, 2), dtype=np.intp))
    parts = (
        _foreground_of_run(run.select(slice(k, k + SCANS_PER_CALL)), scene, int(first) + k)
        for run, first in zip((*runs, empty_run), before, strict=True)
        for k in range(0, max(len(run), 1), SCANS_PER_CALL)
    )
    return Foreground(*_join_columns(parts))


def _join_columns(parts: Iterable[Any]) -> Iterator[Any]:
    """The fields of parts, joined one after the other; each is forgotten then, to hold one of them twice only."""
    columns = deque(list(column) for column in zip(*(vars(part).values() for part in parts), strict=True))
    while columns:
        yield np.concatenate(columns.popleft())


# Neighbouring points on one surface are at most this far apart, m, plus the two below: folds of clothes.
_MAX_GAP = 0.12
# The same in beam spacings: beams at 25° to a surface end that far apart.
_MAX_GAP_SPACINGS = 2.5


def _foreground_of_run(run: ScanRun, scene: StaticScene, first: int) -> Foreground:
    """The foreground of successive scans, of which the first has this index."""
    measured = run.read(np.arange(len(run)))
    scan, beam = np.nonzero(scene.background.is_foreground(run.angles, measured))
    field_of_view = abs(run.angles[-1] - run.angles[0]) if len(run.angles) > 1 else 0.0
    spacing = field_of_view / max(len(run.angles) - 1, 1)
    ranges = measured[scan, beam]
    # Two beams to either side: a beam at an edge often ends between the surfaces or returns nothing.
    neighbors = beam[:, None] + np.array([-2, -1, 1, 2])
    outside = (neighbors < 0) | (neighbors >= len(run.angles))
    neighbor_ranges = measured[scan[:, None], np.clip(neighbors, 0, len(run.angles) - 1)]
    # NaN, no measurement, is not nearer.
    at_occlusion = outside | (neighbor_ranges < (ranges * (1 - _MAX_GAP_SPACINGS * spacing) - _MAX_GAP)[:, None])
    return Foreground(
        first + scan, beam, run.angles[beam], ranges,
        np.asarray(run.stamps[scan] + beam * run.increments[scan]), at_occlusion.any(axis=1),
        np.full(len(run), spacing),
    )  # fmt: skip


# Largest gap of neighbouring points on one surface, in standard deviations of a range: the difference of two
# ranges exceeds it in 3 % of the cases, and such parts are merged afterwards.
_MAX_GAP_SIGMAS = 3.0
# Maximum number of beams without a measurement within one surface: dark clothes return single beams only.
_MAX_MISSING_BEAMS = 2
# Allowance for noise in this extent, in standard deviations of a range: one for either end.
_MAX_MERGED_SIGMAS = 2.0


def cluster_foreground(beams: Foreground, width: float, sigma: float, settings: ClusterSettings) -> Clusters:
    """Groups foreground beams to objects.

    Args:
        beams: foreground of all scans.
        width: largest width of the target, m.
        sigma: noise of a range, m.
        settings: of the clusters.

    Returns:
        Objects of at least two beams that are not clearly wider than the target.
    """
    # Of some scans at a time: what is calculated on the way takes more memory than the objects.
    cuts = np.searchsorted(beams.scan, np.arange(SCANS_PER_CALL, len(beams.spacing), SCANS_PER_CALL))
    origin = beams.times[:1].sum()
    parts = (
        _cluster_part(beams.select(slice(*ends)), origin, width, sigma, settings)
        for ends in pairwise([0, *cuts, len(beams.scan)])
    )
    objects = Clusters(*_join_columns(parts))
    return replace(objects, first=np.cumsum(objects.count) - objects.count)


def _cluster_part(
    beams: Foreground, origin: float, width: float, sigma: float, settings: ClusterSettings
) -> Clusters:
    """The objects in some scans, with mean times that are calculated from one time, s, for all."""
    points = beams.ranges[:, None] * beams.direction
    if not len(points):
        return _build_clusters(beams, points, np.empty(0, dtype=np.intp), origin, width, settings)
    step = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    allowed = (
        _MAX_GAP + _MAX_GAP_SIGMAS * sigma + _MAX_GAP_SPACINGS * beams.ranges[1:] * beams.spacing[beams.scan[1:]]
    )
    apart = (np.diff(beams.scan) != 0) | (np.diff(beams.beam) > 1 + _MAX_MISSING_BEAMS) | (step > allowed)
    parts = np.concatenate([[0], np.cumsum(apart)])
    merged_width = settings.max_merged_width * width + _MAX_MERGED_SIGMAS * sigma
    labels = _merge_parts(beams, points, parts, merged_width)
    return _build_clusters(beams, points, labels, origin, width, settings)


def _merge_parts(beams: Foreground, points: Array, parts: NDArray[np.intp], max_width: float) -> NDArray[np.intp]:
    """(P,) labels after joining parts of one scan whose points lie within ``width``, m, all together."""
    first = np.flatnonzero(np.diff(parts, prepend=-1))
    scan = beams.scan[first]
    low, high = np.minimum.reduceat(points, first), np.maximum.reduceat(points, first)
    links: list[NDArray[np.intp]] = []
    # Only the next part and the one after it are tried: farther ones belong to other objects.
    for apart in (1, 2):
        i = np.arange(len(first) - apart)
        j = i + apart
        extent = np.maximum(high[i], high[j]) - np.minimum(low[i], low[j])
        near = (scan[i] == scan[j]) & (np.hypot(extent[:, 0], extent[:, 1]) < max_width)
        links.append(np.stack([i[near], j[near]]))
    return label_parts(len(first), np.concatenate(links, axis=1).T)[parts]


# Minimum number of beams on an object: one beam is a mixed pixel or noise.
_MIN_POINTS = 2


def _build_clusters(
    beams: Foreground,
    points: Array,
    label: NDArray[np.intp],
    origin: float,
    width: float,
    settings: ClusterSettings,
) -> Clusters:
    """Sorts points by cluster and drops the clusters whose size excludes the target."""
    order = np.lexsort((label, beams.scan))
    cluster_index = np.cumsum(np.diff(label[order], prepend=-1) != 0) - 1
    first = np.flatnonzero(np.diff(cluster_index, prepend=-1))
    count = np.diff(first, append=len(cluster_index))
    if len(first):
        extent = np.maximum.reduceat(points[order], first) - np.minimum.reduceat(points[order], first)
        good = (np.hypot(extent[:, 0], extent[:, 1]) <= settings.max_width * width) & (count >= _MIN_POINTS)
        order = order[np.repeat(good, count)]
        count = count[good]
        first = np.cumsum(count) - count
    # Only the outermost beams show whether the object continues beside them.
    last = first + count - 1
    at_occlusion = beams.at_occlusion[order]
    scan = beams.scan[order][first]
    total = np.add.reduceat(beams.times[order] - origin, first) if len(first) else np.empty(0)
    return Clusters(
        points[order], first, count, scan,
        total / count + origin, beams.times[order],
        beams.spacing[scan] if len(scan) else np.empty(0), at_occlusion[first] | at_occlusion[last],
    )  # fmt: skip
