"""Beams of scanners that move while they measure: patterns, ray casting, and errors of the ranges.

The beams of a column are fired at one time, from one origin, in one plane through the sensor's z axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calgraph.geometry import Array, se3
from calgraph.simulation.drive_scenario import DriveSensor, RangeErrors
from calgraph.simulation.drive_world import DriveWorld, MovingBody
from calgraph.simulation.scanners import add_mixed_pixels
from calgraph.simulation.solids import Surface, cast_rays, surface_normals

_GLASS_RETURNS, _GLASS_LOSES = 0.12, 0.1
"""Probabilities that a beam on glass measures the pane, or nothing; the others measure what is behind it."""
_MIN_RANGE = 0.3
"""Nearer returns are of the robot and are dropped by drivers, m."""


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of beams at their times."""

    times: Array
    """(G,) true times, s from the start of the recording."""
    azimuths: Array
    """(G,) in the sensor's frame, rad."""
    elevations: Array
    """(G, B) in the sensor's frame, rad."""

    def __getitem__(self, part: slice) -> "Columns":
        return Columns(self.times[part], self.azimuths[part], self.elevations[part])

    @property
    def directions(self) -> Array:
        """(G, B, 3) unit vectors in the sensor's frame."""
        return beam_directions(self.azimuths[:, None], self.elevations)


class Hits(NamedTuple):
    """What beams hit."""

    ranges: Array
    """(N,) m; infinite where they hit nothing."""
    cosines: Array
    """(N,) of the angle of incidence; 1 where they hit nothing."""
    reflectivities: Array
    """(N,)."""


@dataclass(frozen=True, eq=False)
class ScannerErrors:
    """The errors of one scanner, constant over the drive."""

    bias: float
    """m."""
    scale: float
    grazing_bias: float
    """Times 1 / cos(incidence) - 1, m."""
    dark_bias: float
    """Times reflectivity below 0.5, doubled, m."""
    ring_biases: Array
    """(B,) m."""
    ring_elevations: Array
    """(B,) rad."""


def beam_directions(azimuths: Array, elevations: Array) -> Array:
    """(..., 3) unit vectors."""
    level = np.cos(elevations)
    return np.stack(
        np.broadcast_arrays(np.cos(azimuths) * level, np.sin(azimuths) * level, np.sin(elevations)), axis=-1
    )


def spread_columns(sensor: DriveSensor) -> Array:
    """(G,) azimuths of columns from the middle of the field, ascending, rad."""
    count = round(sensor.sector / sensor.step) + 1
    return np.asarray((np.arange(count) / (count - 1) - 0.5) * np.radians(sensor.sector))


def spread_rings(sensor: DriveSensor) -> Array:
    """(B,) elevations of beams over the largest."""
    return np.linspace(-1, 1, sensor.rings) if sensor.rings > 1 else np.zeros(1)


def sweep_columns(sensor: DriveSensor, centre: float, spin: float, starts: Array, period: float) -> Columns:
    """The columns (C * K) of the sweeps that start at ``starts`` (K,), s, in order.

    Args:
        sensor: a LiDAR or a scanner.
        centre: azimuth of the middle of its field, rad.
        spin: +1 or -1, direction of its rotation.
        starts: of the sweeps, s.
        period: of a turn, s.
    """
    width = np.radians(sensor.sector)
    if sensor.kind == "solid_state":
        # Six lasers behind two prisms whose rates have no common period: no sweep is like the last.
        count = round(sensor.sector / sensor.step * 5)
        times = (starts[:, None] + np.arange(count) / count * period).ravel()
        azimuths = centre + width / 2 * np.sin(2 * np.pi * 7.31 * times) * np.cos(2 * np.pi * 1.77 * times)
        high = 0.8 * np.radians(sensor.elevation)
        middle = high * np.sin(2 * np.pi * 23.9 * times + 1.0)
        return Columns(times, azimuths, middle[:, None] + 0.25 * high * spread_rings(sensor))
    angles = spread_columns(sensor)
    times = (starts[:, None] + (angles - angles[0]) / (2 * np.pi) * period).ravel()
    azimuths = np.tile(centre + spin * angles, len(starts))
    elevations = np.tile(np.radians(sensor.elevation) * spread_rings(sensor), (len(times), 1))
    return Columns(times, azimuths, elevations)


def draw_scanner_errors(errors: RangeErrors, rings: int, rng: np.random.Generator) -> ScannerErrors:
    """Draws the constant errors of a scanner; one without rings has none of rings."""
    bias, scale, grazing, dark = rng.normal(0, 1, 4) * [
        errors.bias, errors.scale, errors.grazing_bias, errors.dark_bias
    ]  # fmt: skip
    of_rings = rng.normal(0, 1, (2, rings)) * (rings > 1)
    elevations = np.radians(errors.ring_elevation) * of_rings[1]
    return ScannerErrors(bias, scale, grazing, dark, errors.ring_bias * of_rings[0], elevations)


def measure(
    world: DriveWorld,
    T_world_sensor: Array,
    columns: Columns,
    sensor: DriveSensor,
    errors: RangeErrors,
    own: ScannerErrors,
    rng: np.random.Generator,
) -> Array:
    """Simulates the ranges (G, B) of columns, m; NaN without a return.

    Args:
        world: the surroundings.
        T_world_sensor: (G, 4, 4) at the times of the columns.
        columns: as the sensor states them; beams deviate.
        sensor: for its range.
        errors: noise.
        own: constant errors of this scanner.
        rng: for the noise.
    """
    directions = turn_beams(T_world_sensor, columns, errors, own, rng)
    origins = np.repeat(T_world_sensor[:, :3, 3].T, columns.elevations.shape[1], axis=1)
    hits, on_glass = cast_world(world.surfaces, origins, directions, sensor.max_range)
    for body in world.bodies:
        _add_body(hits, body, columns, origins, directions, sensor.max_range)
    return add_errors(hits, on_glass, columns, sensor, errors, own, rng)


def turn_beams(
    T_world_sensor: Array, columns: Columns, errors: RangeErrors, own: ScannerErrors, rng: np.random.Generator
) -> Array:
    """The true directions (3, G * B) of beams in the world, which deviate from the stated ones."""
    shape = columns.elevations.shape
    azimuths = columns.azimuths[:, None] + np.radians(errors.direction_noise) * rng.normal(size=shape)
    local = beam_directions(azimuths, columns.elevations + own.ring_elevations)
    turned = np.einsum("gij,gbj->igb", T_world_sensor[:, :3, :3], local, optimize=True)
    return np.asarray(turned.reshape(3, -1))


def cast_world(
    surfaces: Sequence[Surface], origins: Array, directions: Array, max_range: float
) -> tuple[Hits, Hits]:
    """What beams hit behind all glass, and the panes that they hit; their origins are (3, 1) or (3, N)."""
    opaque, panes = ([one for one in surfaces if one.glass == glass] for glass in (False, True))
    hits = _cast(opaque, origins, directions, max_range)
    return hits, _cast(panes, origins, directions, max_range) if panes else hits


def add_errors(
    hits: Hits,
    on_glass: Hits,
    columns: Columns,
    sensor: DriveSensor,
    errors: RangeErrors,
    own: ScannerErrors,
    rng: np.random.Generator,
) -> Array:
    """The measured ranges (G, B) of what beams hit, m; NaN without a return."""
    shape = columns.elevations.shape
    struck = on_glass.ranges < hits.ranges
    chance = rng.random(struck.shape)
    pane = struck & (chance < _GLASS_RETURNS)
    true = np.where(pane, on_glass.ranges, hits.ranges)
    cosines = np.maximum(np.where(pane, on_glass.cosines, hits.cosines), 0.05)
    grey = np.where(pane, on_glass.reflectivities, hits.reflectivities)
    slant = np.minimum(1 / cosines - 1, 6.0)
    # The neighbour on the same ring in the next column; the last column of a sweep has none but itself.
    intervals = np.diff(columns.times, append=np.inf)
    neighbours = np.arange(true.size) + np.repeat(shape[1] * (intervals < 1.5 * intervals.min()), shape[1])
    ranges = add_mixed_pixels(true, neighbours, errors.mixed_pixels, rng)
    ranges = (1 + own.scale) * ranges + own.bias + own.grazing_bias * slant + own.dark_bias * (1 - 2 * grey)
    ranges += np.tile(own.ring_biases, shape[0])
    ranges += errors.noise * (1 + errors.grazing_noise * slant) * rng.normal(size=true.shape)
    if errors.quantum:
        ranges = errors.quantum * np.round(ranges / errors.quantum)
    # The returned light falls with distance, slant and darkness; beyond some limit a beam returns nothing.
    weak = true / sensor.max_range / np.sqrt(np.maximum(cosines * grey, 1e-3))
    lost = rng.random(true.shape) < errors.dropout * (1 + 20 * np.clip(weak - 0.5, 0, 10))
    lost |= struck & ~pane & (chance < _GLASS_RETURNS + _GLASS_LOSES)
    kept = (ranges >= _MIN_RANGE) & (ranges <= sensor.max_range) & np.isfinite(true) & ~lost
    return np.where(kept, ranges, np.nan).reshape(shape)


def _cast(surfaces: Sequence[Surface], origins: Array, directions: Array, max_range: float) -> Hits:
    """The hits of beams, with incidence and reflectivity of what they hit."""
    found = cast_rays(surfaces, origins.T, directions.T)
    ranges = np.where(found.ranges < max_range, found.ranges, np.inf)
    which = np.where(np.isfinite(ranges), found.solid, -1)
    origins = np.broadcast_to(origins, directions.shape)
    cosines, grey = np.ones(len(ranges)), np.full(len(ranges), 0.5)
    order = np.argsort(which, kind="stable")
    ends = np.searchsorted(which[order], np.arange(len(surfaces) + 1))
    for surface, first, last in zip(surfaces, ends[:-1], ends[1:], strict=True):
        rays = order[first:last]
        if not len(rays):
            continue
        R, t = surface.T_world_shape[:3, :3], surface.T_world_shape[:3, 3]
        d = directions[:, rays].T @ R
        points = (origins[:, rays].T - t) @ R + ranges[rays, None] * d
        cosines[rays] = np.abs(np.sum(surface_normals(surface.shape, points) * d, axis=1))
        grey[rays] = surface.reflectivity
    return Hits(ranges, cosines, grey)


def _add_body(
    hits: Hits, body: MovingBody, columns: Columns, origins: Array, directions: Array, max_range: float
) -> None:
    """Puts the hits of a moving body among the others, in place."""
    T_body_world = se3.inverse(body.poses(columns.times))
    beams = columns.elevations.shape[1]
    # Few beams come near to a body: only these are cast.
    centre, radius = body.bounds
    R, t = np.swapaxes(T_body_world[:, :3, :3], 1, 2), T_body_world[:, :3, 3]
    away = np.repeat(np.einsum("gij,gj->ig", R, centre - t), beams, axis=1) - origins
    along = np.sum(away * directions, axis=0)
    rays = np.flatnonzero((np.sum(away**2, axis=0) - along**2 < radius**2) & (along > -radius))
    if not len(rays):
        return
    T = T_body_world[rays // beams]
    start = np.einsum("nij,jn->in", T[:, :3, :3], origins[:, rays]) + T[:, :3, 3].T
    found = _cast(body.surfaces, start, np.einsum("nij,jn->in", T[:, :3, :3], directions[:, rays]), max_range)
    closer = found.ranges < hits.ranges[rays]
    for of_all, of_body in zip(hits, found, strict=True):
        of_all[rays[closer]] = of_body[closer]
