"""Ranges of stationary sensors in a hall: what stands still is cast once, what moves where its rays are near.

A pattern of beams is the same in each sweep, but for solid-state LiDARs with other sweeps; noise differs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index
from calgraph.simulation.drive_beams import Columns, Hits, ScannerErrors, add_errors, cast_world, turn_beams
from calgraph.simulation.drive_scenario import DriveSensor, RangeErrors
from calgraph.simulation.hall_bodies import Mover, cast_mover
from calgraph.simulation.hall_world import Hall
from calgraph.simulation.solids import Surface, cast_rays

_MARGIN = 0.25
"""By which a mover may be beside its place in the middle of a sweep, m: it drives or walks at up to 2.5 m/s."""
_BLOCK = 60_000
"""Rays that are cast at movers together: bounds memory, and keeps arrays in the processor's cache."""
_SAME_POINT = 1e-3
"""What is nearer behind a mirror is the mirror, m."""
_MIRROR_COSINE = 0.7
"""Of what is measured by way of a mirror."""


@dataclass(frozen=True, eq=False)
class _View:
    """Rays from one point: from the sensor, or by way of a mirror from its image."""

    origin: Array
    """(3,) m."""
    rays: Index
    """(N,) of the pattern."""
    directions: Array
    """(3, N)."""
    least: Array
    """(N,) ranges from which on the view counts, m."""

    def near(self, place: Array, radius: float, height: float) -> Index:
        """Rays, by number in this view, that come near to an upright cylinder on a place (3,)."""
        x, y, z = place - self.origin
        level = np.maximum(np.hypot(self.directions[0], self.directions[1]), 1e-6)
        ux, uy = self.directions[:2] / level
        slope = self.directions[2] / level
        along, across = ux * x + uy * y, ux * y - uy * x
        rise, margin = along * slope - z, radius * np.abs(slope) + _MARGIN
        near = (np.abs(across) < radius) & (along > -radius) & (rise > -margin) & (rise < height + margin)
        return np.flatnonzero(near)


class _Still(NamedTuple):
    """What stands still as one pose of the sensor measures it."""

    hits: Hits
    on_glass: Hits
    views: tuple[_View, ...]


def simulate_sweeps(
    hall: Hall,
    sensor: DriveSensor,
    columns: Columns,
    poses: Sequence[Array],
    pose_of_sweep: Index,
    starts: Array,
    errors: RangeErrors,
    own: ScannerErrors,
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """Simulates the ranges (K, G * B) of sweeps, m; NaN without a return.

    Args:
        hall: what stands and moves.
        sensor: for its range.
        columns: of a sweep that starts at 0.
        poses: (4, 4) T_world_sensor, all that the sensor has.
        pose_of_sweep: (K,) which of them.
        starts: (K,) of the sweeps, s.
        errors: noise.
        own: constant errors of this sensor.
        rng: for the noise.
    """
    # The deviations of beams are the same in all poses and sweeps.
    seed = int(rng.integers(2**32))
    still = [_cast_still(hall, sensor, columns, T, errors, own, np.random.default_rng(seed)) for T in poses]
    moving = [_cast_movers(hall, one, columns, starts, pose_of_sweep == pose) for pose, one in enumerate(still)]
    beams = columns.elevations.shape[1]
    ranges = np.empty((len(starts), len(columns.times) * beams), dtype=np.float32)
    for sweep, pose in enumerate(pose_of_sweep.tolist()):
        hits, on_glass, _ = still[pose]
        rays, found = moving[pose][sweep]
        if len(rays):
            hits = Hits(*(one.copy() for one in hits))
            for of_all, of_movers in zip(hits, found, strict=True):
                of_all[rays] = of_movers
        ranges[sweep] = add_errors(hits, on_glass, columns, sensor, errors, own, rng).ravel()
    return ranges


def _cast_still(
    hall: Hall,
    sensor: DriveSensor,
    columns: Columns,
    T_world_sensor: Array,
    errors: RangeErrors,
    own: ScannerErrors,
    rng: np.random.Generator,
) -> _Still:
    poses = np.broadcast_to(T_world_sensor, (len(columns.times), 4, 4))
    directions = turn_beams(poses, columns, errors, own, rng)
    origin, count = T_world_sensor[:3, 3], directions.shape[1]
    hits, on_glass = cast_world(hall.surfaces, origin[:, None], directions, sensor.max_range)
    views = [_View(origin, np.arange(count), directions, np.zeros(count))]
    for mirror in hall.mirrors:
        views += _reflect(hall, mirror, hits, origin, directions)
    return _Still(hits, on_glass, tuple(views))


def _reflect(hall: Hall, mirror: Surface, hits: Hits, origin: Array, directions: Array) -> list[_View]:
    """The view by way of a mirror, whose hits on what stands still replace those of the mirror."""
    R, t = mirror.T_world_shape[:3, :3], mirror.T_world_shape[:3, 3]
    normal = R[:, 2]
    first = mirror.shape.distance(R.T @ (origin - t)[:, None], R.T @ directions)
    rays = np.flatnonzero((first < hits.ranges) & (normal @ directions < 0))
    if not len(rays):
        return []
    turned = directions[:, rays] - 2 * normal[:, None] * (normal @ directions[:, rays])
    starts = (origin[:, None] + first[rays] * directions[:, rays] + _SAME_POINT * turned).T
    opaque = [one for one in hall.surfaces if not one.glass]
    hits.ranges[rays] = first[rays] + cast_rays(opaque, starts, turned.T).ranges
    hits.cosines[rays] = _MIRROR_COSINE
    image = origin - 2 * normal * (normal @ (origin - t))
    return [_View(image, rays, turned, first[rays])]


def _cast_movers(
    hall: Hall, still: _Still, columns: Columns, starts: Array, wanted: NDArray[np.bool_]
) -> list[tuple[Index, Hits]]:
    """By sweep, the rays that hit movers before what stands still, and what they hit."""
    sweeps = np.flatnonzero(wanted)
    middle = starts[sweeps] + columns.times[len(columns.times) // 2]
    empty = np.zeros(0, dtype=np.intp)
    found = [(empty, empty, np.zeros((3, 0)))]
    for mover in hall.movers:
        places = mover.place(middle)
        for view in still.views:
            near = [view.near(place, mover.radius + _MARGIN, mover.height) for place in places.T]
            ends = np.cumsum([0, *map(len, near)])
            blocks = np.searchsorted(ends, np.arange(0, ends[-1], _BLOCK))
            for first, last in pairwise([*np.unique(np.maximum(blocks, 1) - 1).tolist(), len(near)]):
                sweep = np.repeat(sweeps[first:last], np.diff(ends[first : last + 1]))
                rays = np.concatenate(near[first:last])
                if len(rays):
                    found.append(_cast_block(mover, view, columns, starts, sweep, rays, still.hits.ranges))
    sweep, rays, hits = (np.concatenate(one, axis=-1) for one in zip(*found, strict=True))
    # The nearest of what a ray hits.
    order = np.lexsort((hits[0], rays, sweep))
    sweep, rays, hits = sweep[order], rays[order], hits[:, order]
    kept = np.flatnonzero((np.diff(sweep, prepend=-1) != 0) | (np.diff(rays, prepend=-1) != 0))
    cuts = np.searchsorted(sweep[kept], np.arange(len(starts) + 1))
    parts = [kept[first:last] for first, last in pairwise(cuts.tolist())]
    return [(rays[part], Hits(*hits[:, part])) for part in parts]


def _cast_block(
    mover: Mover, view: _View, columns: Columns, starts: Array, sweep: Index, numbers: Index, before: Array
) -> tuple[Index, Index, Array]:
    """Sweeps (M,), rays (M,) of the pattern, and ranges, cosines and reflectivities (3, M) of hits.

    Args:
        mover: what may be hit.
        view: of the rays.
        columns: of the pattern.
        starts: of all sweeps, s.
        sweep: (N,) of each ray.
        numbers: (N,) of each ray in the view.
        before: range at which each ray of the pattern meets what stands still, m.
    """
    rays = view.rays[numbers]
    count = len(columns.times)
    column = rays // columns.elevations.shape[1]
    keys, of_ray = np.unique(sweep * count + column, return_inverse=True)
    times = starts[keys // count] + columns.times[keys % count]
    hits = np.stack(cast_mover(mover, times, of_ray, view.origin, view.directions[:, numbers]))
    hit = np.flatnonzero((hits[0] < before[rays]) & (hits[0] > view.least[numbers]))
    return sweep[hit], rays[hit], hits[:, hit]
