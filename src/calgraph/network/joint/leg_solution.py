"""The joint solution of a network whose scanners measure people's legs.

Each leg is a separate body. Legs are tracked through the views of all scanners under approximate poses; in every
round, beams are associated again with the nearest leg, under the poses and clocks of the round before.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded, solveh_banded

from calgraph.geometry import Array, Index, estimate_spread, se2, se_n
from calgraph.network.joint.body_batches import BodyBatches
from calgraph.network.joint.body_equations import predict_beams, update_weights
from calgraph.network.joint.leg_tracks import ACCELERATION_DENSITY, LegTrack, track_legs
from calgraph.network.joint.legs import OUTLINE, LegObservations, compute_outline_prior
from calgraph.network.joint.path_equations import compute_smoothness_information
from calgraph.network.joint.problem import BodyPath, BodyScans, NetworkProblem, NetworkState
from calgraph.network.joint.range_noise import MAX_EXCESS, MIN_BEAMS, MIN_RATIO
from calgraph.network.joint.scanner_unknowns import correct_points
from calgraph.network.joint.schur import (
    BodyEquations,
    compute_back_substitution,
    compute_path_covariance,
    pack_lower_band,
)
from calgraph.network.joint.solver import NetworkEquations, compute_network_covariance, optimize_network
from calgraph.network.joint.splines import Knots, evaluate_spline
from calgraph.network.joint.systematic_spread import estimate_systematic_sigma
from calgraph.network.tracking.clusters import Foreground
from calgraph.network.tracking.leg_clusters import cluster_legs
from calgraph.parallel.engine import THIS_PROCESS, MapEngine

# Beams of a greater leverage determine the path: their residuals have no information.
_MAX_LEVERAGE = 0.7
# Beams whose range is less certain, m, are near the edge, and not used: the noise of ranges at walls.
_MAX_EDGE_SIGMA = 0.01


@dataclass(frozen=True, eq=False)
class LegNoise:
    """Variances of the models of legs and scanners."""

    range_sigma: Array
    """(S,) noise of ranges, m."""
    bias_variance: float
    """Variance of the bias of a scanner's ranges to a leg, m²."""
    acceleration_density: float
    """Spectral density of the acceleration of legs, m²/s³."""


# Minimum standard deviation of this bias, m: below, it has no effect.
_MIN_BIAS_SIGMA = 0.0005
# Minimum and maximum spectral density of a leg's acceleration in the estimate of it, m²/s³. Legs that stand and
# swing in turns have 2 to 5 in the mean, which smooths swings too much: clocks of real legs are right with 10,
# and three times that of a fast walk is the limit above.
_ACCELERATION_DENSITY_RANGE = (10.0, 100.0)


def estimate_noise(equations: NetworkEquations, background: Array) -> LegNoise:
    """Estimates all variances from a solution of legs.

    Args:
        equations: of the solution.
        background: (S,) noise of each scanner's background, m.
    """
    return LegNoise(
        _estimate_range_noise(equations, background),
        _estimate_bias_variance(equations),
        _estimate_acceleration_density(equations),
    )


def _estimate_acceleration_density(equations: NetworkEquations) -> float:
    """Squared second differences of the control points, over the number of them that the data determine.

    As for the biases, it is a step of the fixed-point iteration for restricted maximum likelihood, for given
    scanners and shapes.
    """
    of_legs = equations.map(_measure_bends)
    squares, determined = np.sum(of_legs, axis=0) if of_legs else (0.0, 0.0)
    least, most = _ACCELERATION_DENSITY_RANGE
    return float(np.clip(squares / max(determined, 1.0), least, most)) if of_legs else most


def _measure_bends(
    _network: NetworkProblem, _state: NetworkState, leg: LegObservations, path: BodyPath, equations: BodyEquations
) -> tuple[float, float]:
    """Sum of squared second differences of one leg, and how many of them the data determine."""
    bend = np.diff(path.control[:, :2], 2, axis=0)
    covariance = np.trace(compute_path_covariance(equations.band)[..., :2, :2], axis1=2, axis2=3)
    at, next_, after = covariance[:, 0], covariance[:, 1], covariance[:, 2]
    variance = at[:-2] + 4 * at[1:-1] + at[2:] - 4 * next_[:-2] - 4 * next_[1:-1] + 2 * after[:-2]
    prior = leg.knots.step**3 * leg.acceleration_density
    return float(np.sum(bend**2)) / leg.knots.step**3, float(np.sum(2 - np.minimum(variance / prior, 2)))


def _estimate_range_noise(equations: NetworkEquations, background: Array) -> Array:
    """(S,) noise of ranges, m: median absolute residual, each divided by the root of one minus its leverage.

    Scanners with few beams on legs have the noise (S,) of their background.
    """
    residuals: list[list[Array]] = [[] for _ in background]
    of_legs = equations.map(_list_residuals)
    for leg, of_scanners in zip(equations.network.bodies, of_legs, strict=True):
        for scans, absolute in zip(leg.scans, of_scanners, strict=True):
            residuals[scans.scanner].append(absolute)
    by_scanner = [np.concatenate([np.zeros(0), *parts]) for parts in residuals]
    estimated = [
        estimate_spread(absolute) if len(absolute) >= MIN_BEAMS else stated
        for absolute, stated in zip(by_scanner, background, strict=True)
    ]
    return np.asarray(np.clip(estimated, MIN_RATIO * background, np.hypot(background, MAX_EXCESS)))


def _list_residuals(
    network: NetworkProblem, state: NetworkState, leg: LegObservations, path: BodyPath, equations: BodyEquations
) -> list[Array]:
    """Absolute residuals of each scanner's beams on one leg, corrected for their leverage, m."""
    path_covariance = compute_path_covariance(equations.band)[..., :2, :2]
    residuals = []
    for beams in predict_beams(network, state, leg, path):
        covariance = _interpolate_covariance(path_covariance, beams.first, beams.weights)[beams.scan]
        J = beams.jacobian[:2].T
        leverage = beams.scans.weight * np.einsum("ni,nij,nj->n", J, covariance, J)
        used = (np.abs(beams.hits.edge_sigma) < _MAX_EDGE_SIGMA) & (leverage < _MAX_LEVERAGE)
        residuals.append(np.abs(beams.residual * beams.sigma)[used] / np.sqrt(1 - leverage[used]))
    return residuals


def _interpolate_covariance(path_covariance: Array, first: Index, weights: Array) -> Array:
    """(V, 2, 2) of the position at V scans, from those of control points (K, 4, 2, 2)."""
    total = np.zeros((len(first), 2, 2))
    for i in range(4):
        for j in range(i, 4):
            part = (weights[:, i] * weights[:, j])[:, None, None] * path_covariance[first + i, j - i]
            total += part if i == j else part + se_n.transpose(part)
    return total


def _estimate_bias_variance(equations: NetworkEquations) -> float:
    """Variance of the biases, m²: their sum of squares over the number of them that the data determine.

    It is a step of the fixed-point iteration for restricted maximum likelihood (Harville, 1977, section 5).
    """
    covariance = compute_network_covariance(equations)
    of_scanners = [covariance.select(columns) for columns in equations.columns]
    of_legs = equations.map(_measure_biases, of_scanners)
    squares, determined = np.sum(of_legs, axis=0) if of_legs else (0.0, 0.0)
    return max(float(squares) / max(float(determined), 1.0), _MIN_BIAS_SIGMA**2)


def _measure_biases(
    _network: NetworkProblem,
    _state: NetworkState,
    leg: LegObservations,
    path: BodyPath,
    equations: BodyEquations,
    covariance: Array,
) -> tuple[float, float]:
    """Sum of squared biases of one leg, and how many of them the data determine.

    The covariance (UL, UL) is that of the scanners.
    """
    bias = path.shape[OUTLINE:]
    by_scanners = compute_back_substitution(equations)[-len(bias) :, :-1]
    variance = _bias_variances(equations, len(bias))
    variance += np.einsum("ij,jk,ik->i", by_scanners, covariance, by_scanners)
    return float(bias @ bias), float(np.sum(1 - np.minimum(variance / leg.bias_variance, 1)))


def _bias_variances(equations: BodyEquations, count: int) -> Array:
    """(L,) variances of the biases, which are last in the shape, for given scanners."""
    shapes, size = equations.shape_count, 3 * len(equations.band)
    factor = cholesky_banded(pack_lower_band(equations.band), lower=True)
    border = equations.border.reshape(size, -1)[:, :shapes]
    information = equations.corner[:shapes, :shapes] - border.T @ cho_solve_banded((factor, True), border)
    return np.asarray(np.diagonal(np.linalg.inv(information))[-count:]).copy()


# Distance from a leg where there is none, m: above all limits.
_FAR = 10.0
# A point behind the centre by more than this share of the radius is not on the visible side.
_MAX_DEPTH_RATIO = 0.3


@dataclass(frozen=True, eq=False)
class LegCandidate:
    """A leg that beams may end on."""

    knots: Knots
    start: float
    """First time at which it was tracked, s."""
    end: float
    """Last time, s."""
    path: BodyPath


# Maximum distance of a point from the outline of its leg, m, plus the one below: shins are up to 2 cm from
# circles, and start paths 3 cm off.
_MAX_DISTANCE = 0.06
# The same in standard deviations of a range.
_MAX_DISTANCE_SIGMAS = 2.0
# Minimum difference between the distances from the outlines of the nearest and the second nearest leg, m:
# otherwise the beam is not used.
_MIN_MARGIN = 0.02


def associate_beams(
    beams: Foreground,
    scanner: int,
    T_root_scanner: Array,
    clock_offset: float,
    systematic: Array,
    sigma: float,
    legs: Sequence[LegCandidate],
) -> list[BodyScans | None]:
    """Associates the beams of one scanner with the leg whose outline is nearest to their end points.

    A beam is not used if it is far from all outlines, or nearly as close to that of a second leg.

    Args:
        beams: foreground of the scanner, in order of time.
        scanner: its index.
        T_root_scanner: (3, 3).
        clock_offset: its clock minus the root clock, s.
        systematic: (E,) its ``SYSTEMATIC_ERRORS``, of which those that displace points are corrected.
        sigma: its noise, m.
        legs: with paths in the root frame.

    Returns:
        The scans of each leg; None without beams.
    """
    nearest, second = np.full((2, len(beams.times)), _FAR)
    leg_of = np.full(len(beams.times), -1)
    direction = beams.direction
    points = se2.apply(T_root_scanner, correct_points(beams.ranges[:, None] * direction, systematic))
    direction = direction @ T_root_scanner[:2, :2].T
    times = beams.times - clock_offset
    for k, leg in enumerate(legs):
        inside = slice(*np.searchsorted(times, [leg.start, leg.end]))
        first, weights, _ = leg.knots.basis_at(times[inside])
        offset = points[inside] - evaluate_spline(leg.path.control[:, :2], first, weights)
        radius = leg.path.shape[0]
        depth = np.sum(offset * direction[inside], axis=1)
        distance = np.abs(np.hypot(*offset.T) - radius)
        distance[depth > _MAX_DEPTH_RATIO * radius] = _FAR
        closer = distance < nearest[inside]
        second[inside] = np.where(closer, nearest[inside], np.minimum(second[inside], distance))
        nearest[inside] = np.where(closer, distance, nearest[inside])
        leg_of[inside][closer] = k
    used = (nearest < _MAX_DISTANCE + _MAX_DISTANCE_SIGMAS * sigma) & (second - nearest > _MIN_MARGIN)
    return [_collect_scans(beams.select(used & (leg_of == k)), scanner) for k in range(len(legs))]


def _collect_scans(beams: Foreground, scanner: int) -> BodyScans | None:
    if not len(beams.times):
        return None
    first = np.flatnonzero(np.diff(beams.scan, prepend=-1))
    times, count = beams.times, np.diff(first, append=len(beams.times))
    mean = np.add.reduceat(times - times[0], first) / count + times[0]
    return BodyScans(
        scanner,
        mean,
        np.asarray(first, dtype=np.intp),
        beams.direction,
        beams.ranges,
        times - np.repeat(mean, count),
        np.ones(len(times)),
    )


AddWalls = Callable[[NetworkProblem, NetworkState], NetworkProblem]
"""Replaces the wall constraints of a problem by those at a state."""


# Error of paths and radii before the second solution, m; added to the noise of ranges. The first solution has
# reduced it.
SECOND_PATH_SIGMA = 0.02
# Standard deviation of the bias of a scanner's ranges to a leg in the first round, m; later rounds estimate it.
_INITIAL_BIAS_SIGMA = 0.01
# Maximum number of trackings of legs: the second one is under the poses and clocks of the first solution, further
# ones follow as long as clocks change.
_MAX_TRACKINGS = 4
# Rounds of association, weights, walls, solution and noise for one tracking.
_ROUNDS = 3
# Levenberg–Marquardt steps of each round: beams are associated again afterwards.
_ITERATIONS = 3
# Change of clock offsets by the solution of a tracking below which it was the last, s: a leg then moves by less
# than 8 mm.
_CLOCK_TOLERANCE = 0.002


def solve_legs(
    network: NetworkProblem,
    state: NetworkState,
    foregrounds: Sequence[Foreground],
    add_walls: AddWalls,
    engine: MapEngine = THIS_PROCESS,
) -> NetworkEquations:
    """Solves jointly for the unknowns of scanners, and the paths and shapes of legs.

    Args:
        network: whose bodies are replaced, with the noise of the background and the priors of rig.yaml.
        state: with start poses and clocks.
        foregrounds: of each scanner.
        add_walls: registers the static backgrounds.
        engine: evaluates legs.

    Returns:
        The normal equations at the minimum of the last round.
    """
    background = network.range_sigma
    prior_sigma = systematic_sigma = network.systematic_sigma
    clusters = [cluster_legs(*pair) for pair in zip(foregrounds, background, strict=True)]
    beams = [one.select(np.argsort(one.times, kind="stable")) for one in foregrounds]
    noise = LegNoise(np.hypot(background, SECOND_PATH_SIGMA), _INITIAL_BIAS_SIGMA**2, ACCELERATION_DENSITY)
    for tracking in range(_MAX_TRACKINGS):
        tracks = track_legs(clusters, state.T_root_scanner, state.clock_offset)
        candidates = [initialize_leg(track) for track in tracks]
        clocks = state.clock_offset
        for round_ in range(_ROUNDS):
            network = replace(network, systematic_sigma=systematic_sigma)
            network, state, candidates = _associate(network, state, candidates, beams, noise)
            network, batches = update_weights(network, state, BodyBatches.place(network.bodies, engine))
            # The averaged poses may be too far off for the registration of walls.
            if tracking + round_ > 0:
                network = add_walls(network, state)
            state, equations = optimize_network(network, state, iterations=_ITERATIONS, batches=batches)
            candidates = [
                replace(candidate, path=path) for candidate, path in zip(candidates, state.paths, strict=True)
            ]
            noise = estimate_noise(equations, background)
            systematic_sigma = estimate_systematic_sigma(equations, prior_sigma, engine)
        if tracking > 0 and np.abs(state.clock_offset - clocks).max() < _CLOCK_TOLERANCE:
            break
    return equations


# Minimum number of beams of a scanner on a leg, otherwise they are not used: they would determine its bias
# poorly.
_MIN_BEAMS = 20


def _associate(
    network: NetworkProblem,
    state: NetworkState,
    candidates: Sequence[LegCandidate],
    beams: Sequence[Foreground],
    noise: LegNoise,
) -> tuple[NetworkProblem, NetworkState, list[LegCandidate]]:
    """The problem of the legs that at least two scanners measure, and its start values."""
    network = replace(network, range_sigma=noise.range_sigma)
    by_scanner = [
        associate_beams(
            one,
            s,
            state.T_root_scanner[s],
            float(state.clock_offset[s]),
            state.systematic[s],
            float(network.range_sigma[s]),
            candidates,
        )
        for s, one in enumerate(beams)
    ]
    measured, bodies, paths = [], [], []
    for candidate, of_scanners in zip(candidates, zip(*by_scanner, strict=True), strict=True):
        scans = tuple(one for one in of_scanners if one and len(one.ranges) >= _MIN_BEAMS)
        if len(scans) >= 2:
            leg, path = _observe_leg(candidate, scans, noise)
            measured.append(candidate)
            bodies.append(leg)
            paths.append(path)
    state = replace(state, paths=tuple(paths))
    return replace(network, bodies=tuple(bodies)), state, measured


def _observe_leg(
    leg: LegCandidate, scans: tuple[BodyScans, ...], noise: LegNoise
) -> tuple[LegObservations, BodyPath]:
    """A leg with its beams; biases start at zero, as the scanners that measure it change."""
    heading, information = predict_headings(leg.path.control[:, :2], leg.knots.step)
    # Headings of the path and of its prior differ by whole turns if the person turned while standing.
    turns = np.round((leg.path.control[:, 2] - heading) / (2 * np.pi))
    observations = LegObservations(
        leg.knots,
        scans,
        heading=heading + 2 * np.pi * turns,
        heading_information=information,
        bias_variance=noise.bias_variance,
        acceleration_density=noise.acceleration_density,
    )
    shape = np.concatenate([leg.path.shape[:OUTLINE], np.zeros(len(scans))])
    return observations, BodyPath(leg.path.control, shape)


# Information, 1/m², that keeps control points without positions invertible; the smoothness determines them.
_RIDGE = 1e-6


# Interval of a path's control points, s: a leg swings from rest to rest in 0.4 s.
_KNOT_INTERVAL = 0.06


def initialize_leg(track: LegTrack) -> LegCandidate:
    """The smoothing spline through the positions of a track, with the shape of the prior."""
    start, end, interval = float(track.times[0]), float(track.times[-1]), _KNOT_INTERVAL
    knots = Knots.spanning(start - interval, end + interval, interval)
    first, weights, _ = knots.basis_at(track.times)
    band, right = np.zeros((4, knots.count)), np.zeros((knots.count, 2))
    information = track.sigma**-2
    for i in range(4):
        np.add.at(right, first + i, (information * weights[:, i])[:, None] * track.positions)
        for j in range(i, 4):
            np.add.at(band[j - i], first + i, information * weights[:, i] * weights[:, j])
    smooth = compute_smoothness_information(interval, ACCELERATION_DENSITY)
    for i in range(3):
        for j in range(i, 3):
            band[j - i, i : knots.count - 2 + i] += smooth[i, j]
    band[0] += _RIDGE
    positions = solveh_banded(band, right, lower=True)
    heading, _ = predict_headings(positions, interval)
    outline, _ = compute_outline_prior()
    return LegCandidate(knots, start, end, BodyPath(np.column_stack([positions, heading]), outline))


# Time over which a path is averaged for the direction of the walk, s: a stride, one swing of a leg.
_STRIDE_DURATION = 1.2
# Mean speed over a stride above which the direction of the path predicts the heading, m/s.
_MIN_WALKING_SPEED = 0.5
# Standard deviation of a leg's heading about the direction of the walk, rad: feet turn outwards by 3 to 10°, and
# the path over a stride turns.
_HEADING_SIGMA = 0.2


def predict_headings(positions: Array, step: float) -> tuple[Array, Array]:
    """The direction of a path over a stride at its control points.

    Args:
        positions: (K, 2) control points, m.
        step: time between two of them, s.

    Returns:
        Headings (K,), rad, and their information (K,), 1/rad²: zero where the person stands. The information of a
        quarter of a stride is that of one heading.
    """
    half = max(round(_STRIDE_DURATION / 2 / step), 1)
    index = np.arange(len(positions))
    low, high = np.maximum(index - half, 0), np.minimum(index + half, len(positions) - 1)
    x, y = (positions[high] - positions[low]).T
    walking = np.hypot(x, y) > _MIN_WALKING_SPEED * step * (high - low)
    heading = np.arctan2(y, x)
    if walking.any():
        heading = np.interp(index, index[walking], np.unwrap(heading[walking]))
    return heading, walking * 4 * step / _STRIDE_DURATION / _HEADING_SIGMA**2
