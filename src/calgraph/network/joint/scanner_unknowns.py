"""The unknowns of a scanner, and how they act on its scans.

Besides pose and clock offset, these are the systematic errors of ranges, angles and clock. A range scale acts like
larger distances and radii of bodies.

A scan plane that is tilted by the rotation vector ``(a, b, 0)`` in the levelled frame turns the beam of azimuth
``φ`` into the vertical plane of azimuth ``φ + c sin 2φ - d cos 2φ``, where it measures ``1 + (a² + b²) / 4 + c cos
2φ + d sin 2φ`` times the horizontal distance, to second order, with ``c = (b² - a²) / 4`` and ``d = -a b / 2``.
Walls and bodies are vertical: only horizontal distances count. ``c`` and ``d`` are the stretches along x and along
the diagonal between x and y, and the constant part of the factor is ``sqrt(c² + d²)``: tilts shorten no range.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.config import Lidar2dUncertainty
from calgraph.geometry import Array, Index
from calgraph.network.joint.planar_poses import NearCovariances
from calgraph.network.joint.problem import BodyScans, NetworkProblem, NetworkState
from calgraph.result import EstimatedParameter

SYSTEMATIC_ERRORS = (
    "range bias",
    "range scale",
    "angle scale",
    "stretch along x",
    "stretch along diagonal",
    "clock drift",
)
"""In the order of :attr:`NetworkState.systematic`; m, and relative errors."""
BEAM_ERRORS = SYSTEMATIC_ERRORS[:5]
"""Those that displace the points of a scan."""
TILT_ERRORS = SYSTEMATIC_ERRORS[3:5]
"""Those by the tilt of the scan plane."""
# The first errors, which scanners may have in common; scan planes are tilted in any direction.
_COMMON_ERRORS = 3
SCANNER_UNKNOWNS = 4 + len(SYSTEMATIC_ERRORS)
"""Pose (3), clock offset, and systematic errors."""
CLOCK, FIRST_SYSTEMATIC = 3, 4
"""Columns of the clock offset and of the first systematic error."""
RANGE_BIAS, RANGE_SCALE, ANGLE_SCALE, STRETCH_X, STRETCH_DIAGONAL, CLOCK_DRIFT = range(len(SYSTEMATIC_ERRORS))
"""Columns of the systematic errors."""
# Those whose effect depends on the azimuth.
_AZIMUTH_ERRORS = [ANGLE_SCALE, STRETCH_X, STRETCH_DIAGONAL]
# Stretch below which the mean stretch is smooth, that of a tilt of 1.1°: the root has no derivative at zero.
_MIN_STRETCH = 1e-4
_UNITS = ("m", "", "", "", "", "")
# Values of an exact scanner: scales are stated as factors.
_STATED = (0.0, 1.0, 1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class SystematicErrors:
    """Estimated systematic errors of S scanners."""

    values: Array
    """(S, E) of the E ``SYSTEMATIC_ERRORS``."""
    covariance: NearCovariances
    """Of the E errors, given the data and all priors."""
    prior: Array
    """(S, E) prior standard deviations; 0 for what is exact."""

    def select(self, scanners: Index) -> "SystematicErrors":
        """Those of some scanners, ascending."""
        return SystematicErrors(
            self.values[scanners], self.covariance.select_scanners(scanners), self.prior[scanners]
        )

    def summarize(self, names: Sequence[str]) -> tuple[EstimatedParameter, ...]:
        """The estimated parameters of the scanners with these names."""
        return tuple(
            EstimatedParameter(
                name, quantity, _UNITS[p], _STATED[p], prior, _STATED[p] + float(value), stddev=float(stddev)
            )
            for name, *of_scanner in zip(names, self.values, self.covariance.stddev, self.prior, strict=True)
            for p, (quantity, value, stddev, prior) in enumerate(
                zip(SYSTEMATIC_ERRORS, *(numbers.tolist() for numbers in of_scanner), strict=True)
            )
            if prior > 0
        )


def list_columns(scanners: Sequence[int]) -> Index:
    """(UL,) rows and columns of L scanners in the equations of all scanners."""
    first = SCANNER_UNKNOWNS * np.array(scanners, dtype=np.intp)
    return np.asarray((first[:, None] + np.arange(SCANNER_UNKNOWNS)).ravel(), dtype=np.intp)


def collect_prior_sigma(uncertainties: Sequence[Lidar2dUncertainty]) -> Array:
    """(S, E) prior standard deviations of ``SYSTEMATIC_ERRORS``; the root's clock is the reference.

    Those of stretches are root mean squares over normal tilts about both axes.
    """
    sigma = np.zeros((len(uncertainties), len(SYSTEMATIC_ERRORS)))
    sigma[:, RANGE_BIAS] = [u.range_bias for u in uncertainties]
    sigma[:, RANGE_SCALE] = [u.range_scale for u in uncertainties]
    sigma[:, ANGLE_SCALE] = [u.angle_scale for u in uncertainties]
    sigma[:, STRETCH_X] = sigma[:, STRETCH_DIAGONAL] = np.radians([u.tilt for u in uncertainties]) ** 2 / 2
    sigma[:, CLOCK_DRIFT] = [u.clock_drift for u in uncertainties]
    sigma[0, CLOCK_DRIFT] = 0
    return sigma


# Share of the variance of errors of ranges and angles that all scanners of a network have in common: they are
# mostly of one make, with one driver. What they have in common is almost unobservable, so that a share of 0 would
# be optimistic; at one half, ten scanners are as uncertain in scale as two with independent errors. Stretches by
# tilts of scan planes are independent.
COMMON_ERROR_SHARE = 0.5


def compute_prior_covariance(sigma: Array) -> Array:
    """(ES, ES) prior covariance of the systematic errors of S scanners from standard deviations (S, E)."""
    kinds = np.tile(np.arange(len(SYSTEMATIC_ERRORS)), len(sigma))
    common = (kinds[:, None] == kinds) & (kinds < _COMMON_ERRORS)
    correlation = np.where(np.eye(len(kinds), dtype=np.bool_), 1.0, COMMON_ERROR_SHARE * common)
    return np.asarray(np.outer(sigma, sigma) * correlation)


def compute_prior_information(sigma: Array) -> tuple[Array, Array]:
    """The inverse of :func:`compute_prior_covariance` as ``D - V Vᵀ`` (Sherman and Morrison, 1950).

    Args:
        sigma: (S, E) standard deviations; the information of what is exact is 0.

    Returns:
        The diagonal D (S, E), and V (S, E, r) by what r kinds of errors have in common.
    """
    own = np.where(np.arange(sigma.shape[1]) < _COMMON_ERRORS, 1 - COMMON_ERROR_SHARE, 1.0)
    exact = sigma == 0
    stddev = np.where(exact, 1.0, sigma)
    common = np.zeros((*sigma.shape, _COMMON_ERRORS))
    for kind in range(_COMMON_ERRORS):
        estimated = ~exact[:, kind]
        # 1 / (1 / c + N / (1 - c)) times what the common part adds to each scanner.
        weight = COMMON_ERROR_SHARE / (1 + COMMON_ERROR_SHARE * (estimated.sum() - 1)) / (1 - COMMON_ERROR_SHARE)
        common[:, kind, kind] = estimated * np.sqrt(weight) / stddev[:, kind]
    return np.where(exact, 0.0, 1 / (own * stddev**2)), common


def split_by_priors(sigma: Array, errors: Array) -> tuple[Array, Array]:
    """Systematic errors in independent parts that are standard normal by :func:`compute_prior_covariance`.

    Args:
        sigma: (S, E) standard deviations; what is exact has no part.
        errors: (S, E, m) m times those of S scanners.

    Returns:
        The part of each scanner (S, E, m), given the most likely part that all have in common (r, m). The sum of
        their squares is that of the errors by :func:`compute_prior_information`.
    """
    estimated = sigma[..., None] > 0
    share = np.where(np.arange(sigma.shape[1]) < _COMMON_ERRORS, COMMON_ERROR_SHARE, 0.0)[:, None]
    scaled = np.divide(errors, sigma[..., None], out=np.zeros_like(errors), where=estimated)
    common = share * scaled.sum(axis=0) / (1 + share * (estimated.sum(axis=0) - 1))
    own = np.where(estimated, scaled - common, 0.0) / np.sqrt(1 - share)
    return own, common[:_COMMON_ERRORS] / np.sqrt(COMMON_ERROR_SHARE)


def compute_root_times(network: NetworkProblem, state: NetworkState, scans: BodyScans) -> Array:
    """(V,) times of scans by the root's clock, s."""
    drift = state.systematic[scans.scanner, CLOCK_DRIFT] * (scans.times - network.mid_time)
    return np.asarray(scans.times - state.clock_offset[scans.scanner] - drift)


def compute_mean_stretch(systematic: Array) -> tuple[Array, Array]:
    """By how much tilts make ranges longer on average (...), and its derivatives (..., 2) by both stretches.

    Args:
        systematic: (..., E or less) ``SYSTEMATIC_ERRORS``.
    """
    stretches = systematic[..., STRETCH_X : STRETCH_DIAGONAL + 1]
    mean = np.sqrt(np.sum(stretches**2, axis=-1) + _MIN_STRETCH**2)
    return np.asarray(mean - _MIN_STRETCH), np.asarray(stretches / mean[..., None])


def linearize_beam_errors(systematic: Array) -> tuple[Array, Array]:
    """The ``BEAM_ERRORS`` (..., 5) with the mean stretch as a part of the range scale, and its derivatives.

    Args:
        systematic: (..., E) of scanners.

    Returns:
        The errors, and their derivatives (..., 5, 5) by the ``BEAM_ERRORS``.
    """
    errors = systematic[..., : len(BEAM_ERRORS)].copy()
    mean, by_stretches = compute_mean_stretch(systematic)
    errors[..., RANGE_SCALE] += mean
    derivative = np.zeros((*errors.shape, len(BEAM_ERRORS)))
    derivative[..., range(len(BEAM_ERRORS)), range(len(BEAM_ERRORS))] = 1
    derivative[..., RANGE_SCALE, STRETCH_X : STRETCH_DIAGONAL + 1] = by_stretches
    return errors, derivative


def rotate_by_small_angles(c: Array, s: Array, angle: Array) -> Array:
    """Rotates unit vectors with components ``c`` and ``s`` (N,) by small angles (N,), rad: (2, N).

    A body turns by less than 0.1 rad within a scan, where the Taylor series is exact to 2e-9. It is much faster
    than sines and cosines of every beam's angle.
    """
    square = angle * angle
    cos, sin = 1 - square / 2 + square * square / 24, angle * (1 - square / 6 + square * square / 120)
    return np.stack([c * cos - s * sin, s * cos + c * sin])


def compute_stretches(systematic: Array, double_azimuth: Array) -> Array:
    """(N,) measured over true ranges, less the range bias, at doubled azimuths as unit vectors (2, N)."""
    mean, _ = compute_mean_stretch(systematic)
    return np.asarray(
        1 + systematic[RANGE_SCALE] + mean + systematic[STRETCH_X : STRETCH_DIAGONAL + 1] @ double_azimuth
    )


def compute_turns(systematic: Array, azimuth: Array, double_azimuth: Array) -> Array:
    """(N,) angles from stated to true beam directions, rad, at azimuths as for :func:`compute_stretches`."""
    cos, sin = double_azimuth
    return np.asarray(
        systematic[ANGLE_SCALE] * azimuth + systematic[STRETCH_X] * sin - systematic[STRETCH_DIAGONAL] * cos
    )


def differentiate_by_azimuth_errors(systematic: Array, scans: BodyScans, ranges: Array, by_turn: Array) -> Array:
    """(3, N) derivatives of measured ranges by the angle scale and the stretches.

    Args:
        systematic: (E,) of the scanner.
        scans: N beams.
        ranges: (N,) true ones, m.
        by_turn: (N,) derivatives of measured ranges by the turn of a beam, m/rad.
    """
    cos, sin = scans.double_azimuth
    _, (by_x, by_diagonal) = compute_mean_stretch(systematic)
    return np.stack(
        [
            scans.azimuth * by_turn,
            (by_x + cos) * ranges + sin * by_turn,
            (by_diagonal + sin) * ranges - cos * by_turn,
        ]
    )


def compute_scanner_jacobian(
    network: NetworkProblem, state: NetworkState, scans: BodyScans, lengths: Array, pose: Array, rate: Array
) -> Array:
    """(V, P, U) of the P parameters of :class:`ScanEquations` by the scanner's unknowns.

    Args:
        network: the problem.
        state: values of its unknowns.
        scans: V of the scanner.
        lengths: (O,) derivatives of the body's outline by the scale of all lengths.
        pose: (V, 3) of the body.
        rate: (V, 3) of the pose, 1/s.
    """
    outline = 3 + len(lengths)
    G = np.zeros((len(pose), outline + 1 + len(_AZIMUTH_ERRORS), SCANNER_UNKNOWNS))
    arm = pose[:, :2] - state.T_root_scanner[scans.scanner, :2, 2]
    G[:, 0, 0] = G[:, 1, 1] = G[:, 2, 2] = -1
    G[:, 0, 2], G[:, 1, 2] = arm[:, 1], -arm[:, 0]
    G[:, :3, CLOCK] = -rate
    systematic = G[..., FIRST_SYSTEMATIC:]
    systematic[:, outline, RANGE_BIAS] = 1
    # Ranges are homogeneous in relative positions and lengths (Euler's theorem).
    at_first = scans.double_azimuth[:, scans.first_beam]
    stretch = compute_stretches(state.systematic[scans.scanner], at_first)[:, None]
    systematic[:, :2, RANGE_SCALE] = arm / stretch
    systematic[:, 3:outline, RANGE_SCALE] = lengths / stretch
    systematic[:, [outline + 1, outline + 2, outline + 3], _AZIMUTH_ERRORS] = 1
    systematic[:, :3, CLOCK_DRIFT] = G[:, :3, CLOCK] * (scans.times - network.mid_time)[:, None]
    return G


def correct_points(points: Array, systematic: Array) -> Array:
    """Points (N, 2) of a scanner without its ``BEAM_ERRORS``."""
    ranges, azimuth = np.linalg.norm(points, axis=1), np.arctan2(points[:, 1], points[:, 0])
    double_azimuth = np.stack([np.cos(2 * azimuth), np.sin(2 * azimuth)])
    ranges = (ranges - systematic[RANGE_BIAS]) / compute_stretches(systematic, double_azimuth)
    azimuth = azimuth + compute_turns(systematic, azimuth, double_azimuth)
    return np.column_stack([ranges * np.cos(azimuth), ranges * np.sin(azimuth)])
