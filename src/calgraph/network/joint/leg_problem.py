"""Measurements and unknowns of single legs in the joint estimation problem of a network."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.config import People
from calgraph.config.settings import LegSettings
from calgraph.geometry import Array
from calgraph.network.joint.problem import BodyObservations, BodyPath
from calgraph.network.tracking.leg_clusters import measure_widths
from calgraph.network.tracking.track import ScannerTracks


@dataclass(frozen=True, eq=False)
class LegObservations(BodyObservations):
    """All measurements of one leg by L scanners, and the prior of its heading."""

    heading: Array
    """(K,) prior mean of the heading at the control points, rad."""
    heading_information: Array
    """(K,) information of this prior, 1/rad²; 0 where the person stands."""
    bias_variance: float
    """Variance of the bias of each scanner's ranges to this leg, m²."""
    acceleration_density: float
    """Spectral density of its acceleration, m²/s³."""


@dataclass(frozen=True, eq=False)
class LegPath(BodyPath):
    """Estimated path and shape of one leg; its radii are those of the ellipse in its outline."""

    shape: Array
    """(B,) of the outline, in the order of :func:`calgraph.network.joint.leg_equations.raycast_legs`, m."""
    bias: Array
    """(L,) of the ranges of each scanner, m."""

    @classmethod
    def from_shape(cls, control: Array, shape: Array, bias: Array) -> "LegPath":
        """The path with control points (K, 3), a shape (B,) and biases (L,)."""
        return cls(control, shape[0] + np.array([-1.0, 1.0]) * shape[1], shape, bias)

    def retract(self, step: Array, min_radius: float) -> "LegPath":
        """The path after a step (3K + B + L,) of control points, shape and bias."""
        path, shape, bias = np.split(step, [self.control.size, self.control.size + len(self.shape)])
        moved = self.shape + shape
        moved[0] = max(moved[0], min_radius)
        return LegPath.from_shape(self.control + path.reshape(-1, 3), moved, self.bias + bias)


# Harmonics of the outline besides those of an ellipse: flat fronts and square corners. The first one is a
# displacement of the path. With 2 and 3 alone, 0.7 to 1.7 mm became 2 to 4 mm in simulated offices.
HARMONICS = (3, 4)
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


def compute_shape_prior() -> tuple[Array, Array]:
    """Mean (B,) and standard deviation (B,) of the shape of legs, m."""
    orders = np.array([2, 2, *HARMONICS], dtype=float)
    mean = np.concatenate([[_RADIUS, _DEPTH_EXCESS], np.zeros(len(orders) - 1)])
    return mean, np.concatenate([[_RADIUS_SIGMA], _HARMONIC_SIGMA * (2 / orders) ** 2])


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
