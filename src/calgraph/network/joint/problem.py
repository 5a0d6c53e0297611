"""The joint estimation problem of a network: measurements, priors, and the values of all unknowns."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from calgraph.config.settings import NetworkEstimationSettings
from calgraph.geometry import Array, Index
from calgraph.network.joint.scanner_prior import ScannerPrior
from calgraph.network.joint.splines import Knots


@dataclass(frozen=True, eq=False)
class BodyScans:
    """One scanner's beams on one body: V scans, N beams."""

    scanner: int
    times: Array
    """(V,) mean time of each scan's beams on the body, by the scanner's clock, s, ascending."""
    first_beam: Index
    """(V,) the first beam of each scan."""
    direction: Array
    """(N, 2) unit vectors, scanner frame."""
    ranges: Array
    """(N,) m."""
    beam_delay: Array
    """(N,) time of each beam after the mean time of its scan, s."""
    weight: Array
    """(N,) robust weights, 0 to 1."""

    @cached_property
    def azimuth(self) -> Array:
        """(N,) of the beams in the scanner frame, rad."""
        return np.asarray(np.arctan2(self.direction[:, 1], self.direction[:, 0]))

    @cached_property
    def double_azimuth(self) -> Array:
        """(2, N) cosines and sines of twice the azimuths."""
        x, y = self.direction.T
        return np.stack([x * x - y * y, 2 * x * y])


@dataclass(frozen=True, eq=False)
class BodyObservations:
    """All measurements of one body, and the prior of its radii."""

    knots: Knots
    scans: tuple[BodyScans, ...]
    """By scanner."""
    radii: Array
    """(2,) prior mean across and along its heading, m."""
    radii_sigma: Array
    """(2,) prior standard deviation, m."""
    faces_forward: bool
    """Whether its heading follows its direction of motion, as people's does and a cylinder's does not."""


@dataclass(frozen=True, eq=False)
class WallConstraint:
    """Relative pose of two scanners from the registration of their static backgrounds."""

    a: int
    b: int
    T_a_b: Array
    """(3, 3) that follows from exact ranges and angles."""
    information: Array
    """(3, 3) in the fixed axes of a; singular where walls constrain fewer than three directions."""
    by_beam_errors: Array = field(default_factory=lambda: np.zeros((3, 10)))
    """(3, 10) derivative of T_a_b by ``BEAM_ERRORS`` of a and of b, in the fixed axes of a."""


@dataclass(frozen=True, eq=False)
class NetworkProblem:
    """All measurements of a network of S scanners, with their noise."""

    count: int
    """S; the first scanner is the root."""
    bodies: tuple[BodyObservations, ...]
    walls: tuple[WallConstraint, ...]
    range_sigma: Array
    """(S,) noise of a range, m."""
    model_error_variance: Array
    """(2,) variances of the displacement (m²) and rotation (rad²) of a body from its path in a scan."""
    clock_sigma: float
    """Prior standard deviation of clock offsets, s; 0 where all clocks are synchronized."""
    systematic_sigma: Array
    """(S, E) prior standard deviations of the E ``SYSTEMATIC_ERRORS``; 0 where they are exact."""
    mid_time: float
    """The time at which clock offsets are those of the state, s: clocks drift."""
    acceleration_density: float
    """Spectral density of a body's acceleration, m²/s³."""
    settings: NetworkEstimationSettings
    """Further parameters of the models of bodies and beams."""
    prior: ScannerPrior | None = None
    """Prior of scanner poses."""

    def count_beams(self) -> Index:
        """(S,) beams of each scanner on bodies."""
        count = np.zeros(self.count, dtype=np.intp)
        for body in self.bodies:
            for scans in body.scans:
                count[scans.scanner] += len(scans.ranges)
        return count


@dataclass(frozen=True, eq=False)
class BodyPath:
    """Estimated path and radii of one body."""

    control: Array
    """(K, 3) control points of position, m, and heading, rad."""
    radii: Array
    """(2,) across and along the heading, m."""

    def retract(self, step: Array, min_radius: float) -> "BodyPath":
        """The path after a step (3K + 2,) of control points and radii."""
        return BodyPath(self.control + step[:-2].reshape(-1, 3), np.maximum(self.radii + step[-2:], min_radius))


@dataclass(frozen=True, eq=False)
class NetworkState:
    """Values of all unknowns."""

    T_root_scanner: Array
    """(S, 3, 3)."""
    clock_offset: Array
    """(S,) scanner clock minus root clock in the middle of the recording, s."""
    systematic: Array
    """(S, E) of the E ``SYSTEMATIC_ERRORS``, zero where the scanner is exact."""
    paths: tuple[BodyPath, ...]
    """One for each body."""
