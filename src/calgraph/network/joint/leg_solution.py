"""The joint solution of a network whose scanners measure people's legs.

Each leg is a separate body. Legs are tracked through the views of all scanners under approximate poses; in every
round, beams are associated again with the nearest leg, under the poses and clocks of the round before.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solveh_banded

from calgraph.geometry import Array, Index, se2
from calgraph.network.joint.body_batches import BodyBatches
from calgraph.network.joint.leg_equations import compute_leg_residuals, raycast_leg
from calgraph.network.joint.leg_noise import LegNoise, estimate_noise
from calgraph.network.joint.leg_problem import LegObservations, LegPath, compute_shape_prior
from calgraph.network.joint.leg_tracks import ACCELERATION_DENSITY, LegTrack, track_legs
from calgraph.network.joint.model_error import TUKEY_LIMIT
from calgraph.network.joint.path_equations import compute_smoothness_information, evaluate_at
from calgraph.network.joint.problem import BodyScans, NetworkProblem, NetworkState
from calgraph.network.joint.scanner_unknowns import correct_points
from calgraph.network.joint.solver import NetworkEquations, optimize_network
from calgraph.network.joint.splines import Knots, evaluate_spline
from calgraph.network.joint.systematic_spread import estimate_systematic_sigma
from calgraph.network.joint.tukey_loss import TukeyLoss
from calgraph.network.tracking.clusters import Foreground
from calgraph.network.tracking.leg_clusters import cluster_legs
from calgraph.parallel.engine import THIS_PROCESS, MapEngine

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
    path: LegPath


@dataclass(frozen=True, eq=False)
class ScannerBeams:
    """The P foreground beams of one scanner in order of time."""

    direction: Array
    """(P, 2) unit vectors, scanner frame."""
    ranges: Array
    """(P,) m."""
    times: Array
    """(P,) by the scanner's clock, s."""
    scan: Index
    """(P,) of each beam."""

    @classmethod
    def from_foreground(cls, beams: Foreground) -> "ScannerBeams":
        """The beams of a foreground, sorted."""
        order = np.argsort(beams.times, kind="stable")
        angles = beams.angles[order]
        direction = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        return cls(direction, beams.ranges[order], beams.times[order], beams.scan[order])


# Maximum distance of a point from the outline of its leg, m, plus the one below: shins are up to 2 cm from
# circles, and start paths 3 cm off.
_MAX_DISTANCE = 0.06
# The same in standard deviations of a range.
_MAX_DISTANCE_SIGMAS = 2.0
# Minimum difference between the distances from the outlines of the nearest and the second nearest leg, m:
# otherwise the beam is not used.
_MIN_MARGIN = 0.02


def associate_beams(
    beams: ScannerBeams,
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
        beams: of the scanner.
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
    direction = beams.direction @ T_root_scanner[:2, :2].T
    points = se2.apply(T_root_scanner, correct_points(beams.ranges[:, None] * beams.direction, systematic))
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
    return [_select_beams(beams, scanner, np.flatnonzero(used & (leg_of == k))) for k in range(len(legs))]


def _select_beams(beams: ScannerBeams, scanner: int, index: Index) -> BodyScans | None:
    if not len(index):
        return None
    first = np.flatnonzero(np.diff(beams.scan[index], prepend=-1))
    count = np.diff(first, append=len(index))
    times = beams.times[index]
    mean = np.add.reduceat(times - times[0], first) / count + times[0]
    return BodyScans(
        scanner,
        mean,
        np.asarray(first, dtype=np.intp),
        beams.direction[index],
        beams.ranges[index],
        times - np.repeat(mean, count),
        np.ones(len(index)),
    )


AddWalls = Callable[[NetworkProblem, NetworkState], NetworkProblem]
"""Replaces the wall constraints of a problem by those at a state."""


# The same before the second solution.
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
) -> tuple[NetworkProblem, NetworkState, NetworkEquations]:
    """Solves jointly for the unknowns of scanners, and the paths and shapes of legs.

    Args:
        network: whose bodies are replaced, with the noise of the background and the priors of rig.yaml.
        state: with start poses and clocks.
        foregrounds: of each scanner.
        add_walls: registers the static backgrounds.
        engine: evaluates legs.

    Returns:
        The problem of the last round, with its minimum and the normal equations there.
    """
    background = network.range_sigma
    prior_sigma = systematic_sigma = network.systematic_sigma
    clusters = [cluster_legs(*pair) for pair in zip(foregrounds, background, strict=True)]
    beams = [ScannerBeams.from_foreground(foreground) for foreground in foregrounds]
    noise = LegNoise(np.hypot(background, SECOND_PATH_SIGMA), _INITIAL_BIAS_SIGMA**2, ACCELERATION_DENSITY)
    for tracking in range(_MAX_TRACKINGS):
        tracks = track_legs(clusters, state.T_root_scanner, state.clock_offset)
        candidates = [initialize_leg(track) for track in tracks]
        clocks = state.clock_offset
        for round_ in range(_ROUNDS):
            network = replace(network, systematic_sigma=systematic_sigma)
            network, state, candidates = _associate(network, state, candidates, beams, noise)
            # The averaged poses may be too far off for the registration of walls.
            if tracking + round_ > 0:
                network = add_walls(network, state)
            batches = BodyBatches.place(network.bodies, engine)
            state, equations = optimize_network(network, state, iterations=_ITERATIONS, batches=batches)
            candidates = [
                replace(candidate, path=path)
                for candidate, (_, path) in zip(candidates, _list_legs(network, state), strict=True)
            ]
            noise = estimate_noise(network, state, equations, background)
            systematic_sigma = estimate_systematic_sigma(network, state, equations, prior_sigma, engine)
        if tracking > 0 and np.abs(state.clock_offset - clocks).max() < _CLOCK_TOLERANCE:
            break
    return network, state, equations


def _list_legs(network: NetworkProblem, state: NetworkState) -> list[tuple[LegObservations, LegPath]]:
    return [
        (leg, path)
        for leg, path in zip(network.bodies, state.paths, strict=True)
        if isinstance(leg, LegObservations) and isinstance(path, LegPath)
    ]


# Minimum number of beams of a scanner on a leg, otherwise they are not used: they would determine its bias
# poorly.
_MIN_BEAMS = 20


def _associate(
    network: NetworkProblem,
    state: NetworkState,
    candidates: Sequence[LegCandidate],
    beams: Sequence[ScannerBeams],
    noise: LegNoise,
) -> tuple[NetworkProblem, NetworkState, list[LegCandidate]]:
    """The problem of the legs that at least two scanners measure, with robust weights, and its start values."""
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
    return _update_weights(replace(network, bodies=tuple(bodies)), state), state, measured


def _observe_leg(
    leg: LegCandidate, scans: tuple[BodyScans, ...], noise: LegNoise
) -> tuple[LegObservations, LegPath]:
    """A leg with its beams; biases start at zero, as the scanners that measure it change."""
    heading, information = predict_headings(leg.path.control[:, :2], leg.knots.step)
    # Headings of the path and of its prior differ by whole turns if the person turned while standing.
    turns = np.round((leg.path.control[:, 2] - heading) / (2 * np.pi))
    (mean, *_), (sigma, *_) = compute_shape_prior()
    observations = LegObservations(
        leg.knots,
        scans,
        np.full(2, mean),
        np.full(2, sigma),
        faces_forward=True,
        heading=heading + 2 * np.pi * turns,
        heading_information=information,
        bias_variance=noise.bias_variance,
        acceleration_density=noise.acceleration_density,
    )
    return observations, LegPath.from_shape(leg.path.control, leg.path.shape, np.zeros(len(scans)))


def _update_weights(network: NetworkProblem, state: NetworkState) -> NetworkProblem:
    """The network with robust weights of beams at a state."""
    loss = TukeyLoss(TUKEY_LIMIT)

    def compute_weights(leg: LegObservations, path: LegPath, k: int) -> Array:
        scans = leg.scans[k]
        _, _, pose, rate = evaluate_at(network, state, leg, path, scans)
        hits = raycast_leg(state, path, scans, pose, rate)
        residual, _ = compute_leg_residuals(network, scans, hits, float(path.bias[k]))
        return loss.compute_weights(residual, np.ones(len(residual), dtype=np.bool_))

    bodies = []
    for leg, path in _list_legs(network, state):
        scans = [replace(one, weight=compute_weights(leg, path, k)) for k, one in enumerate(leg.scans)]
        bodies.append(replace(leg, scans=tuple(scans)))
    return replace(network, bodies=tuple(bodies))


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
    shape, _ = compute_shape_prior()
    return LegCandidate(
        knots, start, end, LegPath.from_shape(np.column_stack([positions, heading]), shape, np.zeros(0))
    )


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
