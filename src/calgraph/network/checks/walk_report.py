"""Report of the walks through a network under its final poses: capture rows, residuals, and floor plans."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se2
from calgraph.network.pairs.synchronized_tracks import SimultaneousPairs, TrackSamples, pair_samples
from calgraph.network.tracking.track import ScannerTracks
from calgraph.result import CaptureRow, FloorView

# Sizes of the report, for pages of a few megabytes: whitened residuals of the histogram, static points and
# positions of the floor plan.
_MAX_RESIDUALS, _MAX_POINTS, _MAX_POSITIONS = 20_000, 12_000, 30_000
# Size of the cells that static points are thinned to, m, a pixel of the floor plan; lines of walks are split at
# longer gaps, ticks.
_CELL_SIZE = 0.03
_MAX_GAP_TICKS = 10


@dataclass(frozen=True, eq=False)
class CrossScannerMatches:
    """Positions that several scanners of a network detected at the same time."""

    max_distance: float
    """Of simultaneous positions of one person, m."""
    distance: Mapping[str, Array]
    """(S,) by scanner, from each of its samples to its nearest match, m; infinite without a match."""
    others_active: Mapping[str, NDArray[np.bool_]]
    """(S,) by scanner, whether another scanner detected a person at that time, anywhere."""
    residuals: Array
    """(R, 2) differences of matched positions, in standard deviations."""


def match_across_scanners(
    samples: Mapping[str, TrackSamples], T_root_scanner: Mapping[str, Array], max_distance: float
) -> CrossScannerMatches:
    """Matches the samples of all pairs of connected scanners that detected anything near each other.

    Args:
        samples: by scanner; those without a pose are left out.
        T_root_scanner: poses (3, 3) of the connected scanners.
        max_distance: of simultaneous positions of one person, m.
    """
    names = [name for name in samples if name in T_root_scanner]
    distance = {name: np.full(len(samples[name].tick), np.inf) for name in names}
    residuals = [np.zeros((0, 2))]
    for a, b in _list_near_scanners(names, samples, T_root_scanner, max_distance):
        both = pair_samples(samples[a], samples[b])
        offset = se2.apply(T_root_scanner[a], both.x_a) - se2.apply(T_root_scanner[b], both.x_b)
        d = np.linalg.norm(offset, axis=-1)
        matched = np.flatnonzero(d < max_distance)
        matched = matched[both.are_mutual_nearest(matched, d[matched])] if len(matched) else matched
        np.minimum.at(distance[a], both.row_a[matched], d[matched])
        np.minimum.at(distance[b], both.row_b[matched], d[matched])
        residuals.append(_whiten(offset, both, matched, T_root_scanner[a], T_root_scanner[b]))
    pooled = np.concatenate(residuals)
    ticks, scanners = np.unique(
        np.concatenate([np.zeros(0, dtype=np.intp), *(np.unique(samples[name].tick) for name in names)]),
        return_counts=True,
    )
    others_active = {name: np.isin(samples[name].tick, ticks[scanners > 1]) for name in names}
    return CrossScannerMatches(max_distance, distance, others_active, pooled[:: len(pooled) // _MAX_RESIDUALS + 1])


def _list_near_scanners(
    names: Sequence[str],
    samples: Mapping[str, TrackSamples],
    T_root_scanner: Mapping[str, Array],
    max_distance: float,
) -> Iterator[tuple[str, str]]:
    """Pairs of scanners the bounding boxes of whose positions in the root frame are within a distance."""
    names = [name for name in names if len(samples[name].tick)]
    positions = [se2.apply(T_root_scanner[name], samples[name].positions) for name in names]
    low = np.array([x.min(axis=0) for x in positions]).reshape(-1, 2) - max_distance
    high = np.array([x.max(axis=0) for x in positions]).reshape(-1, 2)
    for k, name in enumerate(names):
        near = np.all((low[k + 1 :] <= high[k]) & (low[k] <= high[k + 1 :]), axis=1)
        yield from ((name, names[k + 1 + other]) for other in np.flatnonzero(near).tolist())


def _whiten(
    offset: Array, both: SimultaneousPairs, matched: NDArray[np.intp], T_root_a: Array, T_root_b: Array
) -> Array:
    R_a, R_b = T_root_a[:2, :2], T_root_b[:2, :2]
    S_a, S_b = both.a.covariances[both.row_a[matched]], both.b.covariances[both.row_b[matched]]
    root = np.linalg.cholesky(R_a @ S_a @ R_a.T + R_b @ S_b @ R_b.T)
    return np.asarray(np.linalg.solve(root, offset[matched, :, None])[..., 0])


def build_walk_rows(
    samples: Mapping[str, TrackSamples], matches: CrossScannerMatches, start: float, min_ticks: int
) -> tuple[CaptureRow, ...]:
    """One row for each scanner and walk, in order of time: whether another scanner detected it too, or why not.

    Args:
        samples: by scanner.
        matches: of the connected ones among them.
        start: of the recording, s.
        min_ticks: matched samples of a shared walk.
    """
    rows = [
        (
            float(of_scanner.times[walk[0]]) - start,
            float(of_scanner.times[walk[-1]]) - start,
            name,
            *_assess_walk(name, walk, matches, min_ticks, of_scanner.tick_period),
        )
        for name, of_scanner in samples.items()
        for walk in _split_walks(of_scanner)
    ]
    return tuple(CaptureRow(n, *row) for n, row in enumerate(sorted(rows, key=lambda row: row[:3])))


def _assess_walk(
    name: str, walk: NDArray[np.intp], matches: CrossScannerMatches, min_ticks: int, tick_period: float
) -> tuple[bool, str, float | None]:
    """Whether the samples of a walk have matches, why not, and their RMS distance, m."""
    if name not in matches.distance:
        return False, "its scanner is not connected to the root", None
    d = matches.distance[name][walk]
    d = d[np.isfinite(d)]
    if len(d) >= min_ticks:
        return True, "", float(np.sqrt(np.mean(d**2)))
    if len(d):
        return False, f"another scanner detected it for less than {min_ticks * tick_period:g} s", None
    if matches.others_active[name][walk].any():
        return (
            False,
            f"other scanners detected people at that time, but not within {matches.max_distance:g} m of it",
            None,
        )
    return False, "no other scanner detected a person at that time", None


def _split_walks(samples: TrackSamples) -> Iterator[NDArray[np.intp]]:
    """The rows of each walk, ascending in time."""
    order = np.argsort(samples.trajectory, kind="stable")
    cuts = np.flatnonzero(np.diff(samples.trajectory[order])) + 1
    return (rows for rows in np.split(order, cuts) if len(rows))


def build_floor_views(
    tracked: Mapping[str, ScannerTracks],
    samples: Mapping[str, TrackSamples],
    T_root_scanner: Mapping[str, Array],
    start: float,
) -> tuple[FloorView, ...]:
    """Static points and walks of each connected scanner in the root frame, thinned for a floor plan.

    Args:
        tracked: by scanner.
        samples: of the same.
        T_root_scanner: poses (3, 3) of the connected scanners.
        start: of the recording, s.
    """
    names = [name for name in tracked if name in T_root_scanner]
    lines = {name: list(_split_lines(samples[name], _MAX_POSITIONS // len(names))) for name in names}
    return tuple(
        FloorView(
            name,
            se2.apply(T_root_scanner[name], _thin_points(tracked[name].background, _MAX_POINTS // len(names))),
            tuple(se2.apply(T_root_scanner[name], samples[name].positions[rows]) for rows in lines[name]),
            tuple(np.asarray(samples[name].times[rows] - start) for rows in lines[name]),
        )
        for name in names
    )


def _thin_points(points: Array, limit: int) -> Array:
    """At most ``limit`` of the finite ones of points (M, 2), one in each cell."""
    points = points[np.isfinite(points).all(axis=1)]
    _, first = np.unique(np.round(points / _CELL_SIZE).astype(np.int64), axis=0, return_index=True)
    return np.asarray(points[np.sort(first)][:: len(first) // max(limit, 1) + 1])


def _split_lines(samples: TrackSamples, limit: int) -> Iterator[NDArray[np.intp]]:
    """Rows of the lines of all walks, thinned to at most ``limit`` samples in total."""
    step = max(3, len(samples.tick) // max(limit, 1) + 1)
    for rows in _split_walks(samples):
        for part in np.split(rows, np.flatnonzero(np.diff(samples.tick[rows]) > _MAX_GAP_TICKS) + 1):
            if len(part) > step:
                yield part[::step]
