"""The unknowns of a scanner, and how they act on its scans.

Besides pose and clock offset, these are the systematic errors of ranges, angles and clock. A range scale acts like
larger distances and radii of bodies.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.config import Lidar2dUncertainty
from calgraph.estimation.network.problem import BodyScans, NetworkProblem, NetworkState
from calgraph.geometry import Array
from calgraph.result import EstimatedParameter

SYSTEMATIC_ERRORS = ("range bias", "range scale", "angle scale", "clock drift")
"""In the order of :attr:`NetworkState.systematic`; m, and relative errors."""
BEAM_ERRORS = SYSTEMATIC_ERRORS[:3]
"""Those that displace the points of a scan."""
SCANNER_UNKNOWNS = 4 + len(SYSTEMATIC_ERRORS)
"""Pose (3), clock offset, and systematic errors."""
CLOCK, FIRST_SYSTEMATIC = 3, 4
"""Columns of the clock offset and of the first systematic error."""
RANGE_BIAS, RANGE_SCALE, ANGLE_SCALE, CLOCK_DRIFT = range(len(SYSTEMATIC_ERRORS))
"""Columns of the systematic errors."""
_UNITS = ("m", "", "", "")
# Values of an exact scanner: scales are stated as factors.
_STATED = (0.0, 1.0, 1.0, 0.0)


@dataclass(frozen=True, eq=False)
class SystematicErrors:
    """Estimated systematic errors of S scanners."""

    values: Array
    """(S, 4) of ``SYSTEMATIC_ERRORS``."""
    covariance: Array
    """(4S, 4S) given the data and all priors, scanner by scanner."""
    prior: Array
    """(S, 4) prior standard deviations; 0 for what is exact."""

    @property
    def covariance_of_estimated(self) -> Array:
        """(E, E) of those that are not exact, in the order of :meth:`summarize`."""
        estimated = np.flatnonzero(self.prior.ravel() > 0)
        return self.covariance[np.ix_(estimated, estimated)]

    def summarize(self, names: Sequence[str]) -> tuple[EstimatedParameter, ...]:
        """The estimated parameters of the scanners with these names."""
        stddev = np.sqrt(np.diagonal(self.covariance)).reshape(self.values.shape)
        return tuple(
            EstimatedParameter(
                name, quantity, _UNITS[p], _STATED[p], prior, _STATED[p] + float(value), stddev=float(stddev)
            )
            for name, *of_scanner in zip(names, self.values, stddev, self.prior, strict=True)
            for p, (quantity, value, stddev, prior) in enumerate(
                zip(SYSTEMATIC_ERRORS, *(numbers.tolist() for numbers in of_scanner), strict=True)
            )
            if prior > 0
        )


def collect_prior_sigma(uncertainties: Sequence[Lidar2dUncertainty], *, estimate_clocks: bool) -> Array:
    """(S, 4) prior standard deviations of ``SYSTEMATIC_ERRORS``; the root's clock is the reference.

    A scan plane that is tilted by ``a`` and ``b`` about two axes measures ranges that are longer than horizontal
    distances by a share of ``(a² + b²) / 4``, averaged over all directions. It is part of the range scale.
    """
    tilt = np.radians([u.tilt for u in uncertainties])
    range_scale = np.hypot([u.range_scale for u in uncertainties], tilt**2 / np.sqrt(2))
    sigma = np.array([[u.range_bias, 0.0, u.angle_scale, u.clock_drift] for u in uncertainties])
    sigma[:, RANGE_SCALE] = range_scale
    sigma[slice(0, 1) if estimate_clocks else slice(None), CLOCK_DRIFT] = 0
    return sigma


def compute_prior_covariance(sigma: Array, common_share: float) -> Array:
    """(4S, 4S) prior covariance of the systematic errors of S scanners, scanner by scanner.

    Args:
        sigma: (S, 4) standard deviations.
        common_share: of the variance of ``BEAM_ERRORS`` that all scanners have in common.
    """
    kinds = np.tile(np.arange(len(SYSTEMATIC_ERRORS)), len(sigma))
    common = (kinds[:, None] == kinds) & (kinds < len(BEAM_ERRORS))
    correlation = np.where(np.eye(len(kinds), dtype=np.bool_), 1.0, common_share * common)
    return np.asarray(np.outer(sigma, sigma) * correlation)


def compute_root_times(network: NetworkProblem, state: NetworkState, scans: BodyScans) -> Array:
    """(V,) times of scans by the root's clock, s."""
    drift = state.systematic[scans.scanner, CLOCK_DRIFT] * (scans.times - network.mid_time)
    return np.asarray(scans.times - state.clock_offset[scans.scanner] - drift)


def predict_measured_ranges(state: NetworkState, scanner: int, ranges: Array) -> Array:
    """The ranges that a scanner measures instead of true ones, m."""
    systematic = state.systematic[scanner]
    return np.asarray((1 + systematic[RANGE_SCALE]) * ranges + systematic[RANGE_BIAS])


def compute_turns(state: NetworkState, scans: BodyScans) -> Array:
    """(N,) angles from stated to true beam directions, rad."""
    return np.asarray(state.systematic[scans.scanner, ANGLE_SCALE] * scans.azimuth)


def compute_scanner_jacobian(
    network: NetworkProblem, state: NetworkState, scans: BodyScans, radii: Array, pose: Array, rate: Array
) -> Array:
    """(V, 7, U) of the parameters of :class:`ScanEquations` by the scanner's unknowns."""
    G = np.zeros((len(pose), 7, SCANNER_UNKNOWNS))
    arm = pose[:, :2] - state.T_root_scanner[scans.scanner, :2, 2]
    G[:, 0, 0] = G[:, 1, 1] = G[:, 2, 2] = -1
    G[:, 0, 2], G[:, 1, 2] = arm[:, 1], -arm[:, 0]
    G[:, :3, CLOCK] = -rate
    systematic = G[..., FIRST_SYSTEMATIC:]
    systematic[:, 5, RANGE_BIAS] = 1
    # Ranges are homogeneous in relative positions and radii (Euler's theorem).
    systematic[:, :2, RANGE_SCALE] = arm / (1 + state.systematic[scans.scanner, RANGE_SCALE])
    systematic[:, 3:5, RANGE_SCALE] = radii / (1 + state.systematic[scans.scanner, RANGE_SCALE])
    systematic[:, 6, ANGLE_SCALE] = 1
    systematic[:, :3, CLOCK_DRIFT] = G[:, :3, CLOCK] * (scans.times - network.mid_time)[:, None]
    return G


def correct_points(points: Array, systematic: Array) -> Array:
    """Points (N, 2) of a scanner without its ``BEAM_ERRORS`` (3,)."""
    bias, range_scale, angle_scale = systematic
    ranges, azimuth = np.linalg.norm(points, axis=1), np.arctan2(points[:, 1], points[:, 0])
    azimuth, ranges = (1 + angle_scale) * azimuth, (ranges - bias) / (1 + range_scale)
    return np.column_stack([ranges * np.cos(azimuth), ranges * np.sin(azimuth)])
