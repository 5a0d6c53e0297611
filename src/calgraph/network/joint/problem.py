"""The joint estimation problem of a network: measurements, priors, and the values of all unknowns."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import NetworkEstimationSettings
from calgraph.geometry import Array, Index
from calgraph.network.joint.planar_poses import ScannerPrior
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
class BodyPath:
    """Estimated path and shape of one body."""

    control: Array
    """(K, 3) control points of position, m, and heading, rad."""
    shape: Array
    """(B,) numbers, m: what they are is of the body."""


@dataclass(frozen=True, eq=False)
class PathPrior:
    """Prior of a path: smooth, with headings near given ones."""

    acceleration_density: float
    """Spectral density of the acceleration, m²/s³."""
    turning_density: float
    """Spectral density of the turning rate, rad²/s."""
    heading_offset: Array
    """(K,) of the headings at the control points from those of the prior, rad."""
    heading_information: Array
    """(K,) 1/rad²."""
    ridge: tuple[float, float]
    """Zero-gradient information of positions, 1/m², and headings, 1/rad², which keeps those invertible that
    nothing determines."""


@dataclass(frozen=True, eq=False)
class PlacedBeams:
    """N beams of V scans in the root frame, and the body at the scans' times."""

    origin: Array
    """(2,) m."""
    direction: Array
    """(2, N) unit vectors."""
    scan: Index
    """(N,) of each beam."""
    delay: Array
    """(N,) after the mean time of the scan, s."""
    stretch: Array
    """(N,) measured over true ranges."""
    pose: Array
    """(V, 3)."""
    rate: Array
    """(V, 3) of the pose, 1/s."""


@dataclass(frozen=True, eq=False)
class BodyHits:
    """Where N beams meet a body."""

    ranges: Array
    """(N,) true ones, m; NaN where a beam misses."""
    jacobian: Array
    """(3 + O, N) of measured ranges by the body's position (2, m) and heading (rad) and O numbers of its outline
    (m)."""
    by_turn: Array
    """(N,) of measured ranges by a turn of the beam about the scanner, m/rad."""
    hit: NDArray[np.bool_]
    """(N,) whether a beam counts as meeting the body."""
    frontal: NDArray[np.bool_]
    """(N,) whether it does so at an angle at which its range may count."""
    edge_sigma: Array
    """(N,) standard deviation of the range by errors across the beam, m."""


@dataclass(frozen=True, eq=False)
class BodyObservations(ABC):
    """All measurements of one body, with all that the solution knows of bodies of its kind.

    Its shape has O numbers of the outline, and then, if it has biases, one of each of its L scanners.
    """

    knots: Knots
    scans: tuple[BodyScans, ...]
    """By scanner."""
    has_biases: ClassVar[bool]
    """Whether what is not modelled of it is a bias of each scanner's ranges; a displacement in each scan if
    not."""
    radius_count: ClassVar[int]
    """Number of radii, with which its shape begins."""

    @property
    @abstractmethod
    def kind(self) -> Literal["ellipses", "cylinders", "legs"]:
        """Of several of these bodies."""

    @property
    @abstractmethod
    def shape_prior(self) -> tuple[Array, Array]:
        """Mean (B,), m, and information (B,), 1/m²."""

    @abstractmethod
    def find_path_prior(self, network: "NetworkProblem", path: BodyPath) -> PathPrior:
        """The prior of its path."""

    @abstractmethod
    def raycast(self, path: BodyPath, beams: PlacedBeams) -> BodyHits:
        """Predicts where beams meet it."""

    @abstractmethod
    def differentiate_by_scale(self, path: BodyPath) -> Array:
        """(O,) derivatives of its outline by the scale of all lengths."""


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
