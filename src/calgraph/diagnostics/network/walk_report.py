"""What became of everybody who walked through a network, under its final poses: rows, residuals and pictures."""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se2
from calgraph.pairwise.synchronized_tracks import (
    TICK_PERIOD,
    SimultaneousPairs,
    TrackSamples,
    pair_simultaneous_samples,
)
from calgraph.result import CaptureRow, FloorView
from calgraph.tracking import Tracked

# Two scanners see one walker where their positions are so near, m, and they share a walk if for so many ticks.
_NEAR = 0.5
_SHARED = 5
# How many are kept: whitened residuals for a histogram; static points and positions for a picture of the floor.
_RESIDUALS, _POINTS, _POSITIONS = 20_000, 12_000, 30_000
# Static points nearer together than this look like one, m; a line through a walk breaks where so many ticks lack.
_CELL = 0.03
_BREAK = 10


@dataclass(frozen=True, eq=False)
class Meeting:
    """What all scanners of a network saw of each other's walkers."""

    distance: Mapping[str, Array]
    """(S,) by scanner, from each of its samples to the nearest of another scanner's, m; infinite without one."""
    company: Mapping[str, NDArray[np.bool_]]
    """(S,) by scanner, whether another scanner saw anybody at that time, wherever."""
    residuals: Array
    """(R, 2) differences of positions that belong together, in standard deviations."""


def met(samples: Mapping[str, TrackSamples], T_root_scanner: Mapping[str, Array]) -> Meeting:
    """Brings what the connected scanners saw at the same time together.

    Args:
        samples: by scanner; those without a pose are left out.
        T_root_scanner: poses (3, 3) of the connected scanners.
    """
    names = [name for name in samples if name in T_root_scanner]
    distance = {name: np.full(len(samples[name].tick), np.inf) for name in names}
    company = {name: np.zeros(len(samples[name].tick), dtype=np.bool_) for name in names}
    residuals = [np.zeros((0, 2))]
    for a, b in itertools.combinations(names, 2):
        both = pair_simultaneous_samples(samples[a], samples[b])
        company[a][both.row_a] = company[b][both.row_b] = True
        off = se2.apply(T_root_scanner[a], both.x_a) - se2.apply(T_root_scanner[b], both.x_b)
        d = np.linalg.norm(off, axis=-1)
        near = np.flatnonzero(d < _NEAR)
        near = near[both.are_mutual_nearest(near, d[near])] if len(near) else near
        np.minimum.at(distance[a], both.row_a[near], d[near])
        np.minimum.at(distance[b], both.row_b[near], d[near])
        residuals.append(_whitened(off, both, near, T_root_scanner[a], T_root_scanner[b]))
    together = np.concatenate(residuals)
    return Meeting(distance, company, together[:: len(together) // _RESIDUALS + 1])


def _whitened(
    off: Array, both: SimultaneousPairs, near: NDArray[np.intp], T_root_a: Array, T_root_b: Array
) -> Array:
    R_a, R_b = T_root_a[:2, :2], T_root_b[:2, :2]
    S_a, S_b = both.a.covariances[both.row_a[near]], both.b.covariances[both.row_b[near]]
    root = np.linalg.cholesky(R_a @ S_a @ R_a.T + R_b @ S_b @ R_b.T)
    return np.asarray(np.linalg.solve(root, off[near, :, None])[..., 0])


def walk_rows(samples: Mapping[str, TrackSamples], meeting: Meeting, start: float) -> tuple[CaptureRow, ...]:
    """One row for each scanner and walk, in order of time: whether another scanner saw it too, or why not.

    Args:
        samples: by scanner.
        meeting: of the connected ones among them.
        start: of the recording, s.
    """
    found = [
        (
            float(own.tick[rows[0]]) * TICK_PERIOD - start,
            float(own.tick[rows[-1]]) * TICK_PERIOD - start,
            name,
            *_outcome(name, rows, meeting),
        )
        for name, own in samples.items()
        for rows in _walks(own)
    ]
    return tuple(CaptureRow(n, *row) for n, row in enumerate(sorted(found, key=lambda row: row[:3])))


def _outcome(name: str, rows: NDArray[np.intp], meeting: Meeting) -> tuple[bool, str, float | None]:
    """Whether samples of one walk were seen by others, why not, and the distance between the two, m."""
    if name not in meeting.distance:
        return False, "its scanner is not connected to the root", None
    d = meeting.distance[name][rows]
    d = d[np.isfinite(d)]
    if len(d) >= _SHARED:
        return True, "", float(np.sqrt(np.mean(d**2)))
    if len(d):
        return False, f"another scanner saw it for less than {_SHARED * TICK_PERIOD:g} s", None
    if meeting.company[name][rows].any():
        return False, f"other scanners saw somebody meanwhile, but not within {_NEAR:g} m of it", None
    return False, "no other scanner saw anybody meanwhile", None


def _walks(samples: TrackSamples) -> Iterator[NDArray[np.intp]]:
    """The samples of one walk after the other, ascending in time."""
    order = np.argsort(samples.trajectory, kind="stable")
    cuts = np.flatnonzero(np.diff(samples.trajectory[order])) + 1
    return (rows for rows in np.split(order, cuts) if len(rows))


def floor_views(
    tracked: Mapping[str, Tracked],
    samples: Mapping[str, TrackSamples],
    T_root_scanner: Mapping[str, Array],
    start: float,
) -> tuple[FloorView, ...]:
    """What each connected scanner saw, laid on one floor and thinned for a picture.

    Args:
        tracked: by scanner.
        samples: of the same.
        T_root_scanner: poses (3, 3) of the connected scanners.
        start: of the recording, s.
    """
    names = [name for name in tracked if name in T_root_scanner]
    lines = {name: list(_lines(samples[name], _POSITIONS // len(names))) for name in names}
    return tuple(
        FloorView(
            name,
            se2.apply(T_root_scanner[name], _thinned(tracked[name].background, _POINTS // len(names))),
            tuple(se2.apply(T_root_scanner[name], samples[name].positions[rows]) for rows in lines[name]),
            tuple(np.asarray(samples[name].tick[rows] * TICK_PERIOD - start) for rows in lines[name]),
        )
        for name in names
    )


def _thinned(points: Array, most: int) -> Array:
    """At most so many of the finite ones of points (M, 2), one for each small square."""
    points = points[np.isfinite(points).all(axis=1)]
    _, first = np.unique(np.round(points / _CELL).astype(np.int64), axis=0, return_index=True)
    return np.asarray(points[np.sort(first)][:: len(first) // max(most, 1) + 1])


def _lines(samples: TrackSamples, most: int) -> Iterator[NDArray[np.intp]]:
    """Walks as lines of at most so many samples together."""
    step = max(3, len(samples.tick) // max(most, 1) + 1)
    for rows in _walks(samples):
        for part in np.split(rows, np.flatnonzero(np.diff(samples.tick[rows]) > _BREAK) + 1):
            if len(part) > step:
                yield part[::step]
