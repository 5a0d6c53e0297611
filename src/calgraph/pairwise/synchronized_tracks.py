"""Tracks of two scanners on one clock: who was where at the same time, whoever that is for the other scanner.

Scanners are not synchronised, so that tracks are interpolated at the ticks of one clock for all of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calgraph.geometry import Array
from calgraph.tracking import Track, Tracked

Indices = NDArray[np.intp]

TICK = 0.1
"""Time between the ticks, s: smoothed tracks of walking people hold no more than ten positions a second."""
# Tracks are interpolated over gaps of this, s, or so many of their usual intervals.
_GAP = 0.5
_INTERVALS = 2.5
# How a walking person's velocity may change within a gap, m/s².
_ACCELERATION = 1.0
# A track continues an earlier one that ended less than a gap (s) before it at the predicted place (m) ...
_CONTINUED = 0.8
_NEAR = 0.25
# ... give or take what a person's speed changes meanwhile, m/s.
_DRIFT = 0.7


@dataclass(frozen=True, eq=False)
class Samples:
    """All that one scanner saw moving, at the ticks of the common clock; S of them, ascending in tick."""

    tick: Indices
    """(S,) time in ticks."""
    walk: Indices
    """(S,) which of the scanner's walks: tracks of successive periods that continue each other."""
    positions: Array
    """(S, 2) m, sensor frame."""
    velocities: Array
    """(S, 2) m/s."""
    covariances: Array
    """(S, 2, 2) of the positions, m²."""

    @property
    def times(self) -> Array:
        """(S,) s."""
        return np.asarray(self.tick * TICK, dtype=np.float64)

    @cached_property
    def places(self) -> cKDTree:
        """Where the scanner saw somebody, at whatever time."""
        return cKDTree(self.positions)

    def every(self, step: int) -> "Samples":
        """Those of every ``step``-th tick."""
        kept = self.tick % step == 0
        return Samples(
            self.tick[kept], self.walk[kept], self.positions[kept], self.velocities[kept], self.covariances[kept]
        )


@dataclass(frozen=True, eq=False)
class Meetings:
    """All combinations of something that a saw with something that b saw at the same tick; M of them."""

    a: Samples
    b: Samples
    row_a: Indices
    """(M,) ascending indices into a."""
    row_b: Indices
    """(M,) indices into b."""

    def __len__(self) -> int:
        return len(self.row_a)

    @cached_property
    def starts_a(self) -> Indices:
        """Where the combinations of one sample of a begin."""
        return _starts(self.row_a)

    @cached_property
    def x_a(self) -> Array:
        """(M, 2) positions seen by a, m."""
        return np.asarray(self.a.positions[self.row_a])

    @cached_property
    def x_b(self) -> Array:
        """(M, 2) positions seen by b, m."""
        return np.asarray(self.b.positions[self.row_b])

    @cached_property
    def v_b(self) -> Array:
        """(M, 2) velocities seen by b, m/s."""
        return np.asarray(self.b.velocities[self.row_b])

    @cached_property
    def sight_a(self) -> Array:
        """(M, 2) unit vectors from a to what it saw."""
        return _unit(self.x_a)

    @cached_property
    def sight_b(self) -> Array:
        """(M, 2) unit vectors from b to what it saw, in its frame."""
        return _unit(self.x_b)

    @cached_property
    def variance(self) -> Array:
        """(M,) variances of a coordinate's difference, m², averaged over all directions."""
        traces = [np.trace(s.covariances, axis1=1, axis2=2) for s in (self.a, self.b)]
        return np.asarray((traces[0][self.row_a] + traces[1][self.row_b]) / 2)

    def mutual(self, rows: Indices, d2: Array) -> NDArray[np.bool_]:
        """(n,) which of some combinations, ascending, are each other's nearest, ``d2`` (n,) being squared."""
        return _is_least_of_run(self.row_a[rows], d2) & _is_least(self.row_b[rows], d2)


def meetings(a: Samples, b: Samples) -> Meetings:
    """Combines everything that two scanners saw at the same ticks."""
    first, last = np.searchsorted(b.tick, a.tick, "left"), np.searchsorted(b.tick, a.tick, "right")
    count = last - first
    row_a = np.repeat(np.arange(len(a.tick)), count)
    within = np.arange(len(row_a)) - np.repeat(np.cumsum(count) - count, count)
    return Meetings(a, b, row_a, np.repeat(first, count) + within)


def sample(tracked: Tracked) -> Samples:
    """Interpolates a scanner's tracks at the ticks of the clock that all scanners share."""
    tracks = [track for track in tracked.tracks if len(track.times)]
    parts = [_at_ticks(walk, i) for i, walk in enumerate(_walks(tracks))]
    if not parts:
        return Samples(*(np.zeros(0, dtype=np.intp),) * 2, *(np.zeros((0, 2)),) * 2, np.zeros((0, 2, 2)))
    tick, walk, x, v, S = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(tick, kind="stable")
    return Samples(tick[order], walk[order], x[order], v[order], S[order])


def _walks(tracks: Sequence[Track]) -> list[list[Track]]:
    """Joins the tracks that continue each other: a new period cuts everybody's track, but nobody's walk.

    A wrong join does no harm beyond its neighbourhood, since walks are compared in short stretches.
    """
    if not tracks:
        return []
    tracks = sorted(tracks, key=lambda track: float(track.times[0]))
    begin, end = (np.array([track.times[k] for track in tracks]) for k in (0, -1))
    x_begin, x_end = (np.array([track.positions[k] for track in tracks]) for k in (0, -1))
    v_begin, v_end = (np.array([track.velocities[k] for track in tracks]) for k in (0, -1))
    gap = begin[None] - end[:, None]
    midway = x_end[:, None] + (v_end[:, None] + v_begin[None]) / 2 * gap[..., None]
    distance = np.linalg.norm(midway - x_begin[None], axis=-1)
    fits = (gap > 0) & (gap < _CONTINUED) & (distance < _NEAR + _DRIFT * gap)
    distance = np.where(fits, distance, np.inf)
    next_of, previous_of = np.argmin(distance, axis=1), np.argmin(distance, axis=0)
    walks: list[list[Track]] = []
    walk_of: dict[int, list[Track]] = {}
    for i, track in enumerate(tracks):
        before = int(previous_of[i])
        if fits[before, i] and next_of[before] == i:
            walk_of[i] = walk_of[before]
        else:
            walk_of[i] = []
            walks.append(walk_of[i])
        walk_of[i].append(track)
    return walks


def _at_ticks(walk: Sequence[Track], number: int) -> tuple[Indices, Indices, Array, Array, Array]:
    """Cubic Hermite interpolation of one walk, which keeps to positions and velocities; none over long gaps."""
    t = np.concatenate([track.times for track in walk])
    x = np.concatenate([track.positions for track in walk])
    v = np.concatenate([track.velocities for track in walk])
    S = np.concatenate([track.covariances for track in walk])
    usable = np.isfinite(x).all(axis=1) & np.isfinite(v).all(axis=1) & np.isfinite(S).all(axis=(1, 2))
    usable[1:] &= np.diff(t) > 0
    t, x, v, S = t[usable], x[usable], v[usable], S[usable]
    if len(t) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2, 2))
    tick = np.arange(np.ceil(t[0] / TICK), np.floor(t[-1] / TICK) + 1).astype(np.intp)
    k = np.clip(np.searchsorted(t, tick * TICK, "right") - 1, 0, len(t) - 2)
    h = np.diff(t)
    bridged = h[k] <= max(_GAP, _INTERVALS * float(np.median(h)))
    tick, k = tick[bridged], k[bridged]
    gap = h[k][:, None]
    u = (tick * TICK - t[k])[:, None] / gap
    positions = (
        (1 + 2 * u) * (1 - u) ** 2 * x[k]
        + u * (1 - u) ** 2 * gap * v[k]
        + u**2 * (3 - 2 * u) * x[k + 1]
        + u**2 * (u - 1) * gap * v[k + 1]
    )
    velocities = (1 - u) * v[k] + u * v[k + 1]
    # The neighbours' errors are those of one smoother, nearly the same: they do not average out. What the walker
    # did in between is unknown, and most so in the middle of the gap.
    swerve = (_ACCELERATION * (u * (1 - u) * gap) ** 2)[..., None] ** 2
    w = u[..., None]
    covariances = (1 - w) * S[k] + w * S[k + 1] + swerve * np.eye(2)
    return tick, np.full(len(tick), number, dtype=np.intp), positions, velocities, covariances


def _unit(x: Array) -> Array:
    return np.asarray(x / np.maximum(np.hypot(x[:, :1], x[:, 1:]), 1e-6))


def _is_least(group: Indices, value: Array) -> NDArray[np.bool_]:
    order = np.argsort(group, kind="stable")
    out = np.empty(len(group), dtype=bool)
    out[order] = _is_least_of_run(group[order], value[order])
    return out


def _is_least_of_run(ascending: Indices, value: Array) -> NDArray[np.bool_]:
    starts = _starts(ascending)
    least = np.minimum.reduceat(value, starts)
    return np.asarray(value == np.repeat(least, np.diff(starts, append=len(value))))


def _starts(ascending: Indices) -> Indices:
    begins = np.ones(len(ascending), dtype=np.bool_)
    np.not_equal(ascending[1:], ascending[:-1], out=begins[1:])
    return np.flatnonzero(begins)
