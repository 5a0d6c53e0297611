"""Measurements of 2-D scanners, spinning 2-D scanners and multi-beam LiDARs."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se3
from calgraph.sensors import LaserScan, PointCloud
from calgraph.sensors.beam_pattern import BeamPattern
from calgraph.simulation.rig_scenario import BeamOptions
from calgraph.simulation.solids import Solid, cast_rays

SceneAt = Callable[[float, float], Sequence[tuple[float, Sequence[Solid]]]]
"""The scene between two times: its states as (end of validity, solids), in order; the last covers the end."""

_MIN_DEPTH_STEP = 0.1
"""Neighbouring beams whose ranges differ by more than this hit two surfaces, m."""


def simulate_ranges(
    pattern: BeamPattern,
    T_world_sensor: Array,
    start: float,
    scene_at: SceneAt,
    noise: BeamOptions,
    rng: np.random.Generator,
) -> Array:
    """Simulates the ranges (N,) of one scan or sweep that starts at a time, m; NaN without a return.

    Beams are cast along their true direction, which deviates from the nominal one by the angle noise.
    """
    error = rng.normal(0.0, noise.angle_noise, len(pattern.times))[:, None]
    R = T_world_sensor[:3, :3]
    directions = (np.cos(error) * pattern.directions + np.sin(error) * pattern.sideways) @ R.T
    origins = se3.apply(T_world_sensor, pattern.origins)
    true = np.full(len(directions), np.inf)
    first = 0
    for until, solids in scene_at(start, start + float(pattern.times[-1])):
        last = int(np.searchsorted(pattern.times, until - start, side="right"))
        part = slice(first, last)
        starts = origins if len(origins) == 1 else origins[part]
        true[part] = cast_rays(solids, starts, directions[part]).ranges
        first = last
    ranges = add_mixed_pixels(true, pattern.neighbours, noise.mixed_pixels, rng) + rng.normal(
        0.0, noise.range_noise, len(true)
    )
    lost = rng.random(len(true)) < noise.dropout
    within = (ranges > 0) & (ranges >= noise.min_range) & (ranges <= noise.max_range) & np.isfinite(ranges)
    return np.where(within & ~lost, ranges, np.nan)


def laser_scan(pattern: BeamPattern, ranges: Array, stamp: float, frame_id: str) -> LaserScan:
    """The message of a 2-D scanner."""
    increment = float(pattern.times[-1]) / max(len(pattern.times) - 1, 1)
    return LaserScan(stamp, frame_id, pattern.angles, ranges, increment)


def point_cloud(pattern: BeamPattern, ranges: Array, stamp: float, frame_id: str) -> PointCloud:
    """The message of a 3-D scanner: the beams with a return, at their nominal directions."""
    kept = np.isfinite(ranges)
    origins = pattern.origins if len(pattern.origins) == 1 else pattern.origins[kept]
    points = origins + ranges[kept, None] * pattern.directions[kept]
    rings = None if pattern.rings is None else pattern.rings[kept]
    return PointCloud(stamp, frame_id, points, rings, pattern.times[kept])


def add_mixed_pixels(
    true: Array, neighbours: NDArray[np.intp], probability: float, rng: np.random.Generator
) -> Array:
    """Adds the effect of the beams' footprint: at depth edges some ranges lie between the two depths."""
    with np.errstate(invalid="ignore"):
        step = true[neighbours] - true
    edge = np.isfinite(step) & (np.abs(step) > _MIN_DEPTH_STEP)
    pairs = np.flatnonzero(edge & (rng.random(len(true)) < probability))
    # The footprint of either beam of the pair may lie across the edge.
    straddling = np.where(rng.random(len(pairs)) < 0.5, pairs, neighbours[pairs])
    ranges = true.copy()
    ranges[straddling] = true[pairs] + rng.random(len(pairs)) * step[pairs]
    return ranges
