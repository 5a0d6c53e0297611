"""Measurements and unknowns of single legs in the joint estimation problem of a network."""

from dataclasses import dataclass

import numpy as np

from calgraph.config.settings import LegBodySettings
from calgraph.geometry import Array
from calgraph.network.joint.problem import BodyObservations, BodyPath


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
    """(B,) of the outline, in the order of :func:`calgraph.network.joint.leg_raycast.raycast_legs`, m."""
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


def compute_shape_prior(settings: LegBodySettings) -> tuple[Array, Array]:
    """Mean (B,) and standard deviation (B,) of the shape of legs, m."""
    orders = np.array([2, 2, *settings.harmonics], dtype=float)
    mean = np.concatenate([[settings.radius, settings.depth_excess], np.zeros(len(orders) - 1)])
    return mean, np.concatenate([[settings.radius_sigma], settings.harmonic_sigma * (2 / orders) ** 2])
