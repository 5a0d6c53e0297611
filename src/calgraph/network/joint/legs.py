"""Bodies that are single legs, with outlines that are nearly ellipses.

The outline of a leg differs from the model in a way that depends on the side from which a scanner measures it. The
bias of each scanner and leg stands for that; the elimination of the leg marginalises it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from calgraph.config import People
from calgraph.config.settings import LegSettings
from calgraph.geometry import Array
from calgraph.network.joint.problem import (
    BodyHits,
    BodyObservations,
    BodyPath,
    NetworkProblem,
    PathPrior,
    PlacedBeams,
)
from calgraph.network.tracking.leg_clusters import measure_widths
from calgraph.network.tracking.track import ScannerTracks

# Harmonics of the outline besides those of an ellipse: flat fronts and square corners. The first one is a
# displacement of the path. With 2 and 3 alone, 0.7 to 1.7 mm became 2 to 4 mm in simulated offices.
HARMONICS = (3, 4)
OUTLINE = 3 + len(HARMONICS)
"""Numbers of an outline: radius, amplitudes of the ellipse, and those of harmonics."""
# Prior mean of a leg's mean radius, m: half widths of shins are 58 mm, and half depths 66 mm.
_RADIUS = 0.065
# Prior mean of the amplitude of the second harmonic, m: half of the excess of a shin's half depth over its half
# width. It also lets headings converge, which circles do not determine.
_DEPTH_EXCESS = 0.004
# Prior standard deviation of a leg's mean radius, m: people differ by 15 %, and trousers add as much. A radius
# common to all legs would make the network as much too large or too small.
_RADIUS_SIGMA = 0.015
# Prior standard deviation of the second harmonic, m, which an ellipse has: shins are up to 2 cm deeper than wide,
# half of which is the amplitude. That of harmonic k is smaller by (2/k)²: outlines have no corners.
_HARMONIC_SIGMA = 0.01


def compute_outline_prior() -> tuple[Array, Array]:
    """Mean (O,) and standard deviation (O,) of the outlines of legs, m."""
    orders = np.array([2, 2, *HARMONICS], dtype=float)
    mean = np.concatenate([[_RADIUS, _DEPTH_EXCESS], np.zeros(len(orders) - 1)])
    return mean, np.concatenate([[_RADIUS_SIGMA], _HARMONIC_SIGMA * (2 / orders) ** 2])


# Offset of a beam from the centre, over the radius, beyond which the outline is continued linearly: its slope is
# infinite at the edge. Edges determine the radius, so these beams count.
_MAX_EDGE_RATIO = 0.92
# Scale r₀ of the amplitudes of the ellipse, m: it makes them comparable with those of harmonics.
_SCALE = 0.065


@dataclass(frozen=True, eq=False)
class LegHits:
    """Predicted ranges of N beams to legs."""

    ranges: Array
    """(N,) m."""
    slope: Array
    """(N,) derivative of the range by the beam's offset from the centre: the effect of lateral errors."""
    jacobian: Array
    """(N, 3 + B) of the ranges by position (2, m) and heading (rad) of the leg in the beams' frame, and by the
    B parameters of its shape, m."""


def raycast_legs(origin: Array, direction: Array, center: Array, heading: Array, shape: Array) -> LegHits:
    """Predicts the range of each beam to its leg; all in one frame.

    Args:
        origin: (2,) of the beams, m.
        direction: (N, 2) unit vectors.
        center: (N, 2) of the leg, m.
        heading: (N,) rad.
        shape: (B,) radius r, amplitudes a and b of the ellipse, and the amplitude of each harmonic, m.
    """
    radius, a, b = shape[:3]
    c, s = np.cos(2 * heading), np.sin(2 * heading)
    A, B = (a * c - b * s) / _SCALE, (a * s + b * c) / _SCALE
    q, d = (center - origin).T, direction.T
    scaled = _scale(A, B, d)
    length = np.hypot(*scaled)
    u = scaled / length
    n = np.stack([-u[1], u[0]])
    along, e = _dot(q_scaled := _scale(A, B, q), u), _dot(q_scaled, n)
    x = e / radius
    inside = np.clip(x, -_MAX_EDGE_RATIO, _MAX_EDGE_RATIO)
    cos = np.sqrt(1 - inside * inside)
    depth_slope = -inside / cos
    depth = cos + depth_slope * (x - inside)
    angle = np.arctan2(u[1], u[0]) + np.pi + np.arcsin(inside) - heading
    deviation, by_angle, by_harmonics = np.zeros_like(x), np.zeros_like(x), []
    for k, amplitude in zip(HARMONICS, shape[3:], strict=True):
        c_k = np.cos(k * angle)
        deviation += amplitude * c_k
        by_angle -= k * amplitude * np.sin(k * angle)
        by_harmonics.append(-c_k / cos)
    by_e = -depth_slope - np.where(x == inside, (by_angle + deviation * x / cos) / (cos**2 * radius), 0.0)
    ranges = along - radius * depth - deviation / cos
    by_q = u + n * by_e
    by_turn = e - along * by_e - by_angle / cos

    def by_matrix(q_change: Array, d_change: Array) -> Array:
        """Derivative by an entry of S, which changes the scaled centre and direction as given."""
        turn = _dot(n, d_change) / length
        return np.asarray((_dot(by_q, q_change) + turn * by_turn - ranges * _dot(u, d_change) / length) / length)

    by_A = by_matrix(np.stack([-q[0], q[1]]), np.stack([-d[0], d[1]]))
    by_B = by_matrix(-q[::-1], -d[::-1])
    by_center = _scale(A, B, by_q) / length
    jacobian = [
        *by_center,
        2 * (A * by_B - B * by_A) + by_angle / (cos * length),
        (-depth - x * by_e) / length,
        (c * by_A + s * by_B) / _SCALE,
        (c * by_B - s * by_A) / _SCALE,
        *(column / length for column in by_harmonics),
    ]
    return LegHits(ranges / length, by_e, np.stack(jacobian, axis=1))


def _scale(A: Array, B: Array, vectors: Array) -> Array:
    """Vectors (2, N) in scaled coordinates."""
    x, y = vectors
    return np.stack([x - A * x - B * y, y - B * x + A * y])


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(a[0] * b[0] + a[1] * b[1])


# Zero-gradient information (1/m², 1/rad²) that keeps control points without measurements invertible: 30 m, 10 rad.
_POSITION_RIDGE, _HEADING_RIDGE = 1e-3, 1e-2
# Spectral density of the turning rate of a leg, rad²/s: a standard deviation of 1.4 rad in 1 s.
_TURNING_DENSITY = 2.0
# Standard deviation of the outline across a beam, m; times the slope of the range, it adds to the noise. Folds of
# trousers and the width of beams (0.2° are 14 mm at 4 m) move edges. Over eight simulated recordings, 4 mm gave a
# NEES of 2.2, 8 mm 1.4 and 12 mm 1.05, at the same error of 1.8 mm.
_EDGE_SIGMA = 0.01


@dataclass(frozen=True, eq=False)
class LegObservations(BodyObservations):
    """All measurements of one leg; its outline is in the order of :func:`raycast_legs`."""

    heading: Array
    """(K,) prior mean of the heading at the control points, rad."""
    heading_information: Array
    """(K,) information of this prior, 1/rad²; 0 where the person stands."""
    bias_variance: float
    """Variance of the bias of each scanner's ranges to this leg, m²."""
    acceleration_density: float
    """Spectral density of its acceleration, m²/s³."""
    has_biases: ClassVar[bool] = True
    radius_count: ClassVar[int] = 1

    @property
    def kind(self) -> Literal["ellipses", "cylinders", "legs"]:
        """Of several of these."""
        return "legs"

    @property
    def shape_prior(self) -> tuple[Array, Array]:
        """Mean and information of outline and biases."""
        mean, sigma = compute_outline_prior()
        scanners = len(self.scans)
        information = np.concatenate([sigma**-2, np.full(scanners, 1 / self.bias_variance)])
        return np.concatenate([mean, np.zeros(scanners)]), information

    def find_path_prior(self, _network: NetworkProblem, path: BodyPath) -> PathPrior:
        """Legs swing in the direction of the walk."""
        offset = path.control[:, 2] - self.heading
        ridge = _POSITION_RIDGE, _HEADING_RIDGE
        return PathPrior(self.acceleration_density, _TURNING_DENSITY, offset, self.heading_information, ridge)

    def raycast(self, path: BodyPath, beams: PlacedBeams) -> BodyHits:
        """Where beams meet the leg: ranges are less certain near its edges."""
        x, y, heading = beams.pose.T[:, beams.scan] + beams.delay * beams.rate.T[:, beams.scan]
        center, outline = np.stack([x, y], axis=1), path.shape[:OUTLINE]
        hits = raycast_legs(beams.origin, beams.direction.T, center, heading, outline)
        jacobian = beams.stretch * hits.jacobian.T
        # A rotation of the beam acts like the opposite one of the leg about the scanner.
        by_turn = (y - beams.origin[1]) * jacobian[0] - (x - beams.origin[0]) * jacobian[1] - jacobian[2]
        every = np.ones(len(x), dtype=np.bool_)
        return BodyHits(hits.ranges, jacobian, by_turn, every, every, _EDGE_SIGMA * hits.slope)

    def differentiate_by_scale(self, path: BodyPath) -> Array:
        """All lengths of the outline but the amplitudes of the ellipse, which are relative."""
        lengths = path.shape[:OUTLINE].copy()
        lengths[1:3] = 0
        return lengths


# Maximum width of a narrow object, m: bodies are wider from all sides, and two legs are where they touch.
_MAX_NARROW_WIDTH = 0.2
# Share of objects narrower than _MAX_NARROW_WIDTH above which they are legs, where no height is stated.
_MIN_NARROW_SHARE = 0.5


def measures_legs(target: People, tracked: Sequence[ScannerTracks], settings: LegSettings) -> bool:
    """Whether most objects are as narrow as legs; the stated height of the scan plane decides if there is one."""
    if target.height is not None:
        return target.height < settings.max_height
    widths = [measure_widths(one.foreground, one.sigma) for one in tracked if one.foreground]
    narrow = np.concatenate([np.zeros(0), *widths]) < _MAX_NARROW_WIDTH
    return bool(np.count_nonzero(narrow) > _MIN_NARROW_SHARE * len(narrow))
