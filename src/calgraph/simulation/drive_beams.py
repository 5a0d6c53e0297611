"""Beams of scanners that move while they measure: patterns, ray casting, and errors of the ranges.

The beams of a column are fired at one time, from one origin, in one plane through the sensor's z axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se3
from calgraph.simulation.drive_scenario import DriveSensor, RangeErrors
from calgraph.simulation.drive_surfaces import MovingBody, Surface, surface_normals
from calgraph.simulation.drive_world import DriveWorld
from calgraph.simulation.scanners import add_mixed_pixels

_GLASS_RETURNS, _GLASS_LOSES = 0.12, 0.1
"""Probabilities that a beam on glass measures the pane, or nothing; the others measure what is behind it."""
_MAX_DEVIATION = np.radians(0.25)
"""Of a beam from its nominal direction, rad: five standard deviations of the usual errors."""
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


def sweep_columns(sensor: DriveSensor, centre: float, spin: float, starts: Array, period: float) -> Columns:
    """The columns (C * K) of the sweeps that start at ``starts`` (K,), s, in order.

    Args:
        sensor: a LiDAR or a scanner.
        centre: azimuth of the middle of its field, rad.
        spin: +1 or -1, direction of its rotation.
        starts: of the sweeps, s.
        period: of a turn, s.
    """
    ring = np.linspace(-1, 1, sensor.rings) if sensor.rings > 1 else np.zeros(1)
    width = np.radians(sensor.sector)
    if sensor.kind == "solid_state":
        # Six lasers behind two prisms whose rates have no common period: no sweep is like the last.
        count = round(sensor.sector / sensor.step * 5)
        times = (starts[:, None] + np.arange(count) / count * period).ravel()
        azimuths = centre + width / 2 * np.sin(2 * np.pi * 7.31 * times) * np.cos(2 * np.pi * 1.77 * times)
        high = 0.8 * np.radians(sensor.elevation)
        middle = high * np.sin(2 * np.pi * 23.9 * times + 1.0)
        return Columns(times, azimuths, middle[:, None] + 0.25 * high * ring)
    count = round(sensor.sector / sensor.step) + 1
    angles = (np.arange(count) / (count - 1) - 0.5) * width
    times = (starts[:, None] + (angles - angles[0]) / (2 * np.pi) * period).ravel()
    azimuths = np.tile(centre + spin * angles, len(starts))
    elevations = np.tile(np.radians(sensor.elevation) * ring, (len(times), 1))
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
    hits, on_glass = cast_world(world.surfaces, T_world_sensor, columns, directions, sensor.max_range)
    for body in world.bodies:
        _add_body(hits, body, T_world_sensor, columns, directions, sensor.max_range)
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
    surfaces: Sequence[Surface], T_world_sensor: Array, columns: Columns, directions: Array, max_range: float
) -> tuple[Hits, Hits]:
    """What beams with directions (3, G * B) hit behind all glass, and the panes that they hit."""
    opaque, panes = ([one for one in surfaces if one.glass == glass] for glass in (False, True))
    hits = _cast(opaque, T_world_sensor, columns, directions, max_range)
    return hits, _cast(panes, T_world_sensor, columns, directions, max_range) if panes else hits


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


def _cast(
    surfaces: Sequence[Surface], T_world_sensor: Array, columns: Columns, directions: Array, max_range: float
) -> Hits:
    """Hits of beams, whose directions are (3, G * B) in the world."""
    beams = columns.elevations.shape[1]
    near = _columns_near(surfaces, T_world_sensor, columns, max_range)
    places = T_world_sensor[:, :3, 3].T
    ranges = np.full(directions.shape[1], np.inf)
    which = np.full(directions.shape[1], -1, dtype=np.int32)
    by_column = directions.reshape(3, -1, beams)
    for index, surface in enumerate(surfaces):
        chosen = np.flatnonzero(near[index])
        if not len(chosen):
            continue
        rays = (chosen[:, None] * beams + np.arange(beams)).ravel()
        R, t = surface.T_world_shape[:3, :3], surface.T_world_shape[:3, 3:]
        starts = np.repeat(R.T @ (places[:, chosen] - t), beams, axis=1)
        distance = surface.shape.distance(starts, R.T @ by_column[:, chosen].reshape(3, -1))
        closer = (distance < ranges[rays]) & (distance < max_range)
        ranges[rays[closer]] = distance[closer]
        which[rays[closer]] = index
    return _describe_hits(surfaces, which, ranges, np.repeat(places, beams, axis=1), directions)


def _columns_near(
    surfaces: Sequence[Surface], T_world_sensor: Array, columns: Columns, max_range: float
) -> NDArray[np.bool_]:
    """(S, G) which columns may hit the bounding spheres of surfaces: of most surfaces few do."""
    centres = np.stack([surface.T_world_shape[:3, 3] for surface in surfaces])
    radii = np.array([[surface.shape.bounding_radius] for surface in surfaces])
    low, high = columns.elevations.min(axis=1), columns.elevations.max(axis=1)
    half = np.pi / 2
    margin = radii + _MAX_DEVIATION * max_range
    near = np.ones((len(surfaces), len(columns.times)), dtype=bool)
    for sign, azimuth, elevation in (
        (1.0, columns.azimuths + half, np.zeros_like(low)),
        (-1.0, columns.azimuths + half, np.zeros_like(low)),
        (1.0, columns.azimuths, high + half),
        (1.0, columns.azimuths, low - half),
        (-1.0, columns.azimuths, (low + high) / 2),
    ):
        outward = np.einsum("gij,gj->gi", T_world_sensor[:, :3, :3], beam_directions(azimuth, elevation))
        beyond = centres @ outward.T - np.sum(outward * T_world_sensor[:, :3, 3], axis=1)
        near &= sign * beyond <= margin
    return near


def _add_body(
    hits: Hits, body: MovingBody, T_world_sensor: Array, columns: Columns, directions: Array, max_range: float
) -> None:
    """Puts the hits of a moving body among the others, in place."""
    T_body_sensor = se3.inverse(body.poses(columns.times)) @ T_world_sensor
    # Few columns come near to a body: only theirs are cast.
    chosen = np.flatnonzero(_columns_near([body.bounds], T_body_sensor, columns, max_range)[0])
    if not len(chosen):
        return
    beams = columns.elevations.shape[1]
    rays = (chosen[:, None] * beams + np.arange(beams)).ravel()
    R = T_body_sensor[chosen, :3, :3] @ np.swapaxes(T_world_sensor[chosen, :3, :3], 1, 2)
    local = np.einsum("gij,jgb->igb", R, directions[:, rays].reshape(3, -1, beams)).reshape(3, -1)
    part = Columns(columns.times[chosen], columns.azimuths[chosen], columns.elevations[chosen])
    found = _cast(body.surfaces, T_body_sensor[chosen], part, local, max_range)
    closer = found.ranges < hits.ranges[rays]
    for of_all, of_body in zip(hits, found, strict=True):
        of_all[rays[closer]] = of_body[closer]


def _describe_hits(
    surfaces: Sequence[Surface], which: NDArray[np.int32], ranges: Array, origins: Array, directions: Array
) -> Hits:
    """Hits with incidence and reflectivity from the surface (N,) that each beam hit, -1 for none."""
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
