"""Tracks of two scanners resampled at the ticks of a common clock, and all simultaneous pairs of their samples.

Scanners are not synchronized, so tracks are interpolated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calgraph.geometry import Array, Index, select_rows
from calgraph.network.tracking.track import ScannerTracks, Track

# Time between the ticks, s: smoothed tracks of walking people have a bandwidth below 5 Hz. Matches, expected
# detections and evidence are counted in ticks: with another period, limits on these have to be scaled.
TICK_PERIOD = 0.1


def to_ticks(seconds: float) -> int:
    """Rounds a duration, s, to ticks."""
    return round(seconds / TICK_PERIOD)


@dataclass(frozen=True, eq=False)
class TrackSamples:
    """Positions of the objects that one scanner tracked, at ticks of the common clock: S, ascending in tick."""

    tick: Index
    """(S,) time in ticks."""
    trajectory: Index
    """(S,) index of the trajectory: tracks of successive periods that continue each other."""
    positions: Array
    """(S, 2) m, sensor frame."""
    velocities: Array
    """(S, 2) m/s."""
    covariances: Array
    """(S, 2, 2) of the positions, m²."""

    @property
    def times(self) -> Array:
        """(S,) s."""
        return np.asarray(self.tick * TICK_PERIOD, dtype=np.float64)

    @cached_property
    def tree(self) -> cKDTree:
        """KD-tree of the positions at all times."""
        return cKDTree(self.positions)

    def transform(self, mirrored: bool, delay: int) -> "TrackSamples":
        """The samples some ticks earlier, and mirrored at the x axis as those of a scanner mounted upside-down."""
        signs = np.array([1.0, -1.0 if mirrored else 1.0])
        return replace(
            self,
            tick=self.tick - delay,
            positions=self.positions * signs,
            velocities=self.velocities * signs,
            covariances=self.covariances * np.outer(signs, signs),
        )

    def subsample(self, step: int) -> "TrackSamples":
        """Selects every ``step``-th tick."""
        return select_rows(self, self.tick % step == 0)


@dataclass(frozen=True, eq=False)
class SimultaneousPairs:
    """All M combinations of a sample of a with a sample of b at the same tick."""

    a: TrackSamples
    b: TrackSamples
    row_a: Index
    """(M,) ascending indices into a."""
    row_b: Index
    """(M,) indices into b."""

    def __len__(self) -> int:
        return len(self.row_a)

    @cached_property
    def run_starts_a(self) -> Index:
        """Row of the first combination of each sample of a."""
        return _run_starts(self.row_a)

    @cached_property
    def trajectories(self) -> Index:
        """(M,) one number for each combination of a trajectory of a with a trajectory of b."""
        of_a, of_b = self.a.trajectory[self.row_a], self.b.trajectory[self.row_b]
        return np.asarray(of_a * (int(self.b.trajectory.max()) + 1) + of_b)

    @cached_property
    def x_a(self) -> Array:
        """(M, 2) positions in a, m."""
        return np.asarray(self.a.positions[self.row_a])

    @cached_property
    def x_b(self) -> Array:
        """(M, 2) positions in b, m."""
        return np.asarray(self.b.positions[self.row_b])

    @cached_property
    def v_b(self) -> Array:
        """(M, 2) velocities in b, m/s."""
        return np.asarray(self.b.velocities[self.row_b])

    @cached_property
    def ray_a(self) -> Array:
        """(M, 2) unit vectors from a to its positions, in a."""
        return _normalize(self.x_a)

    @cached_property
    def ray_b(self) -> Array:
        """(M, 2) unit vectors from b to its positions, in b."""
        return _normalize(self.x_b)

    @cached_property
    def variance(self) -> Array:
        """(M,) variances of the difference of positions, m², averaged over all directions."""
        traces = [np.trace(s.covariances, axis1=1, axis2=2) for s in (self.a, self.b)]
        return np.asarray((traces[0][self.row_a] + traces[1][self.row_b]) / 2)

    def are_mutual_nearest(self, rows: Index, d2: Array) -> NDArray[np.bool_]:
        """(n,) mask of ascending rows (n,) that are mutual nearest neighbours by squared distances ``d2`` (n,)."""
        return _is_minimum_of_run(self.row_a[rows], d2) & _is_minimum_of_group(self.row_b[rows], d2)


def pair_samples(a: TrackSamples, b: TrackSamples) -> SimultaneousPairs:
    """Combines the samples of two scanners at the same ticks."""
    first, last = np.searchsorted(b.tick, a.tick, "left"), np.searchsorted(b.tick, a.tick, "right")
    count = last - first
    row_a = np.repeat(np.arange(len(a.tick)), count)
    within = np.arange(len(row_a)) - np.repeat(np.cumsum(count) - count, count)
    return SimultaneousPairs(a, b, row_a, np.repeat(first, count) + within)


def resample_tracks(tracked: ScannerTracks) -> TrackSamples:
    """Interpolates a scanner's tracks at the ticks of the clock common to all scanners."""
    tracks = [track for track in tracked.tracks if len(track.times)]
    parts = [_interpolate_at_ticks(joined, i) for i, joined in enumerate(_join_tracks(tracks))]
    if not parts:
        none, vectors = np.zeros(0, dtype=np.intp), np.zeros((0, 2))
        return TrackSamples(none, none, vectors, vectors, np.zeros((0, 2, 2)))
    tick, trajectory, x, v, S = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(tick, kind="stable")
    return TrackSamples(tick[order], trajectory[order], x[order], v[order], S[order])


# Longest time between two tracks of one trajectory, s: a new period begins within some scans.
_MAX_JOIN_GAP = 0.8
# Distance from the predicted position at which a track continues another, m: half of a person's width.
_MAX_JOIN_DISTANCE = 0.25
# Additional distance per second of the gap, m/s: half of a walking speed.
_MAX_JOIN_SPEED = 0.7


def _join_tracks(tracks: Sequence[Track]) -> list[list[Track]]:
    """Joins tracks that continue each other: a new period ends all tracks, but not the motion of the objects.

    A wrong join has only local effects, since trajectories are compared in short stretches.
    """
    if not tracks:
        return []
    tracks = sorted(tracks, key=lambda track: float(track.times[0]))
    begin, end = (np.array([track.times[k] for track in tracks]) for k in (0, -1))
    x_begin, x_end = (np.array([track.positions[k] for track in tracks]) for k in (0, -1))
    v_begin, v_end = (np.array([track.velocities[k] for track in tracks]) for k in (0, -1))
    # Only tracks that begin soon after the end of another one: there are many in long recordings.
    first, last = (np.searchsorted(begin, limit, "right") for limit in (end, end + _MAX_JOIN_GAP))
    count = np.maximum(last - first, 0)
    before = np.repeat(np.arange(len(tracks)), count)
    after = np.repeat(first, count) + np.arange(len(before)) - np.repeat(np.cumsum(count) - count, count)
    gap = begin[after] - end[before]
    predicted = x_end[before] + (v_end[before] + v_begin[after]) / 2 * gap[:, None]
    distance = np.linalg.norm(predicted - x_begin[after], axis=1)
    fits = (gap < _MAX_JOIN_GAP) & (distance < _MAX_JOIN_DISTANCE + _MAX_JOIN_SPEED * gap)
    before, after, distance = before[fits], after[fits], distance[fits]
    next_of, previous_of = _find_nearest(before, after, distance), _find_nearest(after, before, distance)
    trajectories: list[list[Track]] = []
    trajectory_of: dict[int, list[Track]] = {}
    for i, track in enumerate(tracks):
        continued = previous_of.get(i)
        if continued is not None and next_of[continued] == i:
            trajectory_of[i] = trajectory_of[continued]
        else:
            trajectory_of[i] = []
            trajectories.append(trajectory_of[i])
        trajectory_of[i].append(track)
    return trajectories


def _find_nearest(of: Index, other: Index, distance: Array) -> dict[int, int]:
    """For each index in ``of`` (n,) the one of ``other`` (n,) at the least distance (n,)."""
    order = np.lexsort((other, distance, of))
    firsts = order[_run_starts(of[order])]
    return dict(zip(of[firsts].tolist(), other[firsts].tolist(), strict=True))


# Gap of a track that is interpolated, s: about one step of a person, who seldom turns within it.
_MAX_GAP = 0.5
# The same in median intervals of the track, for slow scanners: two missed scans.
_MAX_GAP_INTERVALS = 2.5
# Standard deviation of the acceleration within a gap, m/s²: walking people start and turn with 1 to 2 m/s².
_ACCELERATION = 1.0


def _interpolate_at_ticks(tracks: Sequence[Track], number: int) -> tuple[Index, Index, Array, Array, Array]:
    """Cubic Hermite interpolation of one trajectory through its positions and velocities, except in long gaps."""
    t = np.concatenate([track.times for track in tracks])
    x = np.concatenate([track.positions for track in tracks])
    v = np.concatenate([track.velocities for track in tracks])
    S = np.concatenate([track.covariances for track in tracks])
    usable = np.isfinite(x).all(axis=1) & np.isfinite(v).all(axis=1) & np.isfinite(S).all(axis=(1, 2))
    usable[1:] &= np.diff(t) > 0
    t, x, v, S = t[usable], x[usable], v[usable], S[usable]
    if len(t) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2, 2))
    period = TICK_PERIOD
    tick = np.arange(np.ceil(t[0] / period), np.floor(t[-1] / period) + 1).astype(np.intp)
    k = np.clip(np.searchsorted(t, tick * period, "right") - 1, 0, len(t) - 2)
    h = np.diff(t)
    bridged = h[k] <= max(_MAX_GAP, _MAX_GAP_INTERVALS * float(np.median(h)))
    tick, k = tick[bridged], k[bridged]
    gap = h[k][:, None]
    u = (tick * period - t[k])[:, None] / gap
    positions = (
        (1 + 2 * u) * (1 - u) ** 2 * x[k]
        + u * (1 - u) ** 2 * gap * v[k]
        + u**2 * (3 - 2 * u) * x[k + 1]
        + u**2 * (u - 1) * gap * v[k + 1]
    )
    velocities = (1 - u) * v[k] + u * v[k + 1]
    # The errors of neighbouring samples of one smoother are nearly equal and do not average out. The unknown
    # acceleration in between adds most variance in the middle of the gap.
    acceleration_variance = (_ACCELERATION * (u * (1 - u) * gap) ** 2)[..., None] ** 2
    w = u[..., None]
    covariances = (1 - w) * S[k] + w * S[k + 1] + acceleration_variance * np.eye(2)
    return tick, np.full(len(tick), number, dtype=np.intp), positions, velocities, covariances


def _normalize(x: Array) -> Array:
    return np.asarray(x / np.maximum(np.hypot(x[:, :1], x[:, 1:]), 1e-6))


def _is_minimum_of_group(group: Index, value: Array) -> NDArray[np.bool_]:
    order = np.argsort(group, kind="stable")
    out = np.empty(len(group), dtype=bool)
    out[order] = _is_minimum_of_run(group[order], value[order])
    return out


def _is_minimum_of_run(ascending: Index, value: Array) -> NDArray[np.bool_]:
    starts = _run_starts(ascending)
    least = np.minimum.reduceat(value, starts)
    return np.asarray(value == np.repeat(least, np.diff(starts, append=len(value))))


def _run_starts(ascending: Index) -> Index:
    begins = np.ones(len(ascending), dtype=np.bool_)
    np.not_equal(ascending[1:], ascending[:-1], out=begins[1:])
    return np.flatnonzero(begins)
