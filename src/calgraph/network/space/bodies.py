"""Upright bodies in the sweeps of a levelled sensor: where the silhouettes of their upper halves are.

Source of the bearing: the pilot of the design; the middle of a silhouette is that of a turning body to the first
order, while means of points follow the side that faces the sensor.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index
from calgraph.network.space.static_directions import MovingPoints, StaticView
from calgraph.solver.connected_parts import label_parts


@dataclass(frozen=True, eq=False)
class Bodies:
    """What may be a person in each sweep, by ascending sweep; C in all."""

    sweep: Index
    """(C,)"""
    times: Array
    """(C,) mean time of the points, s."""
    slices: Array
    """(C, B, 3) levelled frame, m, as :attr:`BodyTrack.centers`; NaN where a slice has less than two points."""
    centers: Array
    """(C, 3) the means of these, m."""
    counts: Index
    """(C,) points of the upper body."""
    alone: NDArray[np.bool_]
    """(C,) whether no other body is so near that its points may be of this one."""
    whole: NDArray[np.bool_]
    """(C,) whether both sides of it are in view, and its points of one pass of the sweep."""


# Heights of points that are clustered, and of the upper body, whose silhouette is measured, m over the floor.
_HEIGHTS, _UPPER = (0.4, 2.2), (0.9, 1.9)
# Heights between its slices, m: hips with hands that swing; chest; shoulders and head. Errors of their middles
# that last for a second are 26, 16 and 10 mm in a simulated hall.
_SLICES = 1.2, 1.5
# Edge of cells on the floor, m; cells at most two apart are of one body: gaps of 0.3 m between points.
_CELL, _REACH = 0.15, 2
# Least points of a body, and of its upper half.
_MIN_POINTS, _MIN_UPPER = 6, 4
# Upper bodies that are wider are several people, or a vehicle, m (legs that step are longer); what ends lower than
# this is no person.
_MAX_WIDTH, _MIN_HEIGHT = 1.1, 0.9
# Distance below which bodies are hard to distinguish, m: two people who touch; and least share of the other's
# points, of what is more than an arm of it.
_NEAR, _NEAR_SHARE = 0.9, 0.15
# Beside the edges of a silhouette, rad (0.8° and 1.6°): what ends there by this much nearer, m, hides a part.
_BESIDE, _HIDES = np.radians([0.8, 1.6]), 0.4
# Bodies behind others whose silhouettes come this near to theirs are hidden in part, rad (0.6°).
_HIDDEN = float(np.radians(0.6))
# Gap in the times of a body's points, in sweeps, of bodies that begin and end a sweep.
_SEAM = 0.5


def find_bodies(moving: MovingPoints, T_floor_sensor: Array, view: StaticView) -> Bodies:
    """Clusters moving points over the floor, and measures each."""
    levelled = moving.points @ T_floor_sensor[:3, :3].T + T_floor_sensor[:3, 3]
    used = (levelled[:, 2] > _HEIGHTS[0]) & (levelled[:, 2] < _HEIGHTS[1])
    points, sweep, times = levelled[used], moving.sweep[used], moving.times[used]
    label = cluster(points[:, :2], sweep)
    order = np.lexsort((times, label))
    points, sweep, times, label = points[order], sweep[order], times[order], label[order]
    first = np.flatnonzero(np.diff(label, prepend=-1))
    if not len(first):
        return _build_nothing()
    count = np.diff(first, append=len(label))
    upper = (points[:, 2] > _UPPER[0]) & (points[:, 2] < _UPPER[1])
    good = (count >= _MIN_POINTS) & (np.add.reduceat(upper.astype(np.intp), first) >= _MIN_UPPER)
    good &= np.maximum.reduceat(points[:, 2], first) >= _MIN_HEIGHT
    if not good.any():
        return _build_nothing()
    seam = _find_seams(times, label, moving.duration)
    rows = np.repeat(good, count) & upper
    number = np.cumsum(good)[label[rows]] - 1
    body = points[rows]
    firsts = np.flatnonzero(np.diff(number, prepend=-1))
    n = np.diff(firsts, append=len(number))
    size = np.maximum.reduceat(body[:, :2], firsts) - np.minimum.reduceat(body[:, :2], firsts)
    mean = np.add.reduceat(body, firsts) / n[:, None]
    heading = np.arctan2(mean[:, 1], mean[:, 0])
    bearing = np.arctan2(body[:, 1], body[:, 0]) - heading[number]
    bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
    distance = np.hypot(body[:, 0], body[:, 1])
    slices = _measure_slices(bearing, distance, body[:, 2], number, heading)
    found = np.isfinite(slices[:, :, :1]).sum(axis=1)
    middle = np.nansum(slices, axis=1) / np.maximum(found, 1)
    edges = np.stack([np.minimum.reduceat(bearing, firsts), np.maximum.reduceat(bearing, firsts)], axis=1)
    bodies = Bodies(
        sweep[first[good]],
        np.add.reduceat(times[rows] - times[0], firsts) / n + times[0],
        slices,
        np.where(found > 0, middle, mean),
        n,
        np.hypot(*size.T) <= _MAX_WIDTH,
        (found[:, 0] > 0) & ~seam[good],
    )
    return _mark_neighbors(bodies, heading[:, None] + edges, T_floor_sensor, view)


def _build_nothing() -> Bodies:
    none, flags = np.zeros(0), np.zeros(0, dtype=np.bool_)
    index = np.zeros(0, dtype=np.intp)
    return Bodies(index, none, np.zeros((0, len(_SLICES) + 1, 3)), np.zeros((0, 3)), index, flags, flags)


def cluster(points: Array, sweep: Index, edge: float = _CELL) -> Index:
    """(P,) number of the body of each point (P, 2), ascending in sweep, by cells of an edge length, m."""
    cell = np.floor(points / edge).astype(np.int64)
    # Wide enough that neighbours never reach the next row or sweep.
    low = cell.min(axis=0, initial=0) - _REACH
    width = cell.max(axis=0, initial=0) - low + 2 * _REACH + 1
    key = (sweep.astype(np.int64) * width[0] + cell[:, 0] - low[0]) * width[1] + cell[:, 1] - low[1]
    occupied, of_point = np.unique(key, return_inverse=True)
    ends = []
    for dx in range(_REACH + 1):
        for dy in range(-_REACH if dx else 1, _REACH + 1):
            other = occupied + dx * width[1] + dy
            k = np.minimum(np.searchsorted(occupied, other), len(occupied) - 1)
            rows = np.flatnonzero(occupied[k] == other)
            ends.append(np.stack([rows, k[rows]], axis=1))
    label = label_parts(len(occupied), np.concatenate(ends))
    # Numbered by first cell, so that they ascend with the sweep.
    first = np.unique(label, return_index=True)[1]
    rank = np.empty(len(first), dtype=np.intp)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.asarray(rank[label][of_point], dtype=np.intp)


def _find_seams(times: Array, label: Index, duration: float) -> NDArray[np.bool_]:
    """(C,) whether a body's points, sorted by body and time, are of the begin and the end of a sweep."""
    seam = np.zeros(label[-1] + 1, dtype=np.bool_)
    if duration > 0:
        jump = (np.diff(times) > _SEAM * duration) & (np.diff(label) == 0)
        seam[label[1:][jump]] = True
    return seam


def _measure_slices(bearing: Array, distance: Array, height: Array, number: Index, heading: Array) -> Array:
    """(C, B, 3) middles of slices of bodies: of points by their bodies (P,), at bearings from a heading (C,)."""
    B = len(_SLICES) + 1
    key = number * B + np.searchsorted(_SLICES, height)
    order = np.lexsort((bearing, key))
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    n = np.diff(first, append=len(key))
    of = key[order][first]
    azimuth = heading[of // B] + (bearing[order][first] + bearing[order][first + n - 1]) / 2
    ranges = distance[np.lexsort((distance, key))][first + n // 2]
    mean = np.add.reduceat(height[order], first) / n
    slices = np.full((B * len(heading), 3), np.nan)
    measured = np.column_stack([ranges * np.cos(azimuth), ranges * np.sin(azimuth), mean])
    slices[of[n >= 2]] = measured[n >= 2]
    return slices.reshape(-1, B, 3)


def _mark_neighbors(bodies: Bodies, edges: Array, T_floor_sensor: Array, view: StaticView) -> Bodies:
    """Bodies that are not alone or not whole, as others or static objects are near or before them."""
    alone, whole = bodies.alone.copy(), bodies.whole.copy()
    distance = np.hypot(*bodies.centers[:, :2].T)
    bounds = np.searchsorted(bodies.sweep, np.unique(bodies.sweep))
    for low, high in zip(bounds, np.append(bounds[1:], len(bodies.sweep)), strict=True):
        if high - low > 1:
            here = slice(low, high)
            x, n = bodies.centers[here, :2], bodies.counts[here]
            apart = np.linalg.norm(x[:, None] - x, axis=2)
            big = n >= _NEAR_SHARE * n[:, None]
            alone[here] &= ~((apart < _NEAR) & big & ~np.eye(len(n), dtype=np.bool_)).any(axis=1)
            begin, end = edges[here].T
            turn = (begin - begin[:, None] + np.pi) % (2 * np.pi) - np.pi
            overlaps = (turn < (end - begin)[:, None] + _HIDDEN) & (turn + (end - begin) > -_HIDDEN)
            whole[here] &= ~(overlaps & (distance[here] < distance[here][:, None] - _HIDES)).any(axis=1)
    for side, sign in ((0, -1.0), (1, 1.0)):
        for beside in _BESIDE:
            azimuth = edges[:, side] + sign * beside
            levelled = np.column_stack(
                [distance * np.cos(azimuth), distance * np.sin(azimuth), bodies.centers[:, 2]]
            )
            levelled -= T_floor_sensor[:3, 3]
            static = view.look_up(levelled @ T_floor_sensor[:3, :3])
            whole &= static > np.linalg.norm(levelled, axis=1) - _HIDES
    return replace(bodies, alone=alone, whole=whole)
