"""Simulated scans for trackers: a room with a pillar, and ellipses that walk through it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array
from calgraph.sensors import LaserScan

Walk = Callable[[Array], Array]


def walk_along(waypoints: list[tuple[float, float]], speed: float = 1.2, begin: float = 0.0) -> Walk:
    """A walk with rounded corners along waypoints; NaN before it begins and after it ends."""
    corners = np.array(waypoints)
    ends = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])

    def at(times: Array) -> Array:
        # The mean over 0.8 s of a broken line has no jumps in velocity.
        lags = np.linspace(-0.4, 0.4, 81)
        way = (np.asarray(times)[..., None] - begin + lags) * speed
        xy = np.stack([np.interp(way, ends, corners[:, k]).mean(axis=-1) for k in (0, 1)], axis=-1)
        present = (np.asarray(times) >= begin) & ((np.asarray(times) - begin) * speed <= ends[-1])
        return np.asarray(np.where(present[..., None], xy, np.nan))

    return at


def walk_in_circle(radius: float, center: tuple[float, float], speed: float = 1.2, phase: float = 0.0) -> Walk:
    """An endless walk on a circle."""

    def at(times: Array) -> Array:
        angle = phase + np.asarray(times) * speed / radius
        return np.stack([center[0] + radius * np.cos(angle), center[1] + radius * np.sin(angle)], axis=-1)

    return at


def compute_velocity(walk: Walk, times: Array) -> Array:
    return (walk(times + 0.01) - walk(times - 0.01)) / 0.02


@dataclass(frozen=True, eq=False)
class World:
    """A scanner in the origin, in a rectangular room with a square pillar and walking people."""

    walks: tuple[Walk, ...]
    radii: tuple[float, float] = (0.25, 0.15)
    room: tuple[float, float, float, float] = (-1.0, 11.0, -6.0, 6.0)
    pillar: tuple[float, float, float, float] = (5.0, 5.4, 2.0, 2.4)
    noise: float = 0.02
    beams: int = 541
    fov: float = 1.5 * np.pi
    rate: float = 15.0
    sweep: float = 0.75
    """Fraction of a revolution that a scan takes; negative if the scanner turns clockwise."""

    def simulate_scans(self, seconds: float, seed: int) -> list[LaserScan]:
        rng = np.random.default_rng(seed)
        angles = np.linspace(-self.fov / 2, self.fov / 2, self.beams) * np.sign(self.sweep)
        step = abs(self.sweep) / self.rate / self.beams
        static = self._static_ranges(angles)
        scans = []
        for stamp in 1e9 + np.arange(round(seconds * self.rate)) / self.rate:
            ranges = static.copy()
            for walk in self.walks:
                ranges = np.minimum(
                    ranges, self._ranges_to_person(walk, stamp - 1e9 + step * np.arange(self.beams), angles)
                )
            ranges = ranges + rng.normal(0, self.noise, self.beams)
            scans.append(LaserScan(float(stamp), "laser", angles, ranges, step))
        return scans

    def _static_ranges(self, angles: Array) -> Array:
        d = np.stack([np.cos(angles), np.sin(angles)])
        x0, x1, y0, y1 = self.room
        with np.errstate(divide="ignore"):
            walls = np.minimum(np.where(d[0] > 0, x1, x0) / d[0], np.where(d[1] > 0, y1, y0) / d[1])
            xs, ys = np.array(self.pillar[:2])[:, None] / d[0], np.array(self.pillar[2:])[:, None] / d[1]
        near = np.maximum(np.minimum(*xs), np.minimum(*ys))
        far = np.minimum(np.maximum(*xs), np.maximum(*ys))
        return np.asarray(np.where((near < far) & (near > 0), near, walls))

    def _ranges_to_person(self, walk: Walk, times: Array, angles: Array) -> Array:
        """Ranges (B,) of the beams to an ellipse with its minor axis along the velocity; inf for misses."""
        # The rotation within a scan is neglected.
        few = np.linspace(times[0], times[-1], 3)
        xy, v = walk(few), compute_velocity(walk, few[1:2])[0]
        heading = np.arctan2(v[1], v[0]) + np.pi / 2
        c, s = np.cos(heading), np.sin(heading)
        o = -np.stack([np.interp(times, few, xy[:, k]) for k in (0, 1)], axis=-1)
        d = np.stack([np.cos(angles), np.sin(angles)], axis=-1)

        def scale(p: Array) -> Array:
            return np.stack([c * p[:, 0] + s * p[:, 1], c * p[:, 1] - s * p[:, 0]], axis=-1) / self.radii

        o, d = scale(o), scale(d)
        A, B, C = (d * d).sum(1), (o * d).sum(1), (o * o).sum(1) - 1
        with np.errstate(invalid="ignore"):
            near = (-B - np.sqrt(B * B - A * C)) / A
        return np.asarray(np.where(near > 0, near, np.inf))
