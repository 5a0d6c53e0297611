"""The default estimator of a network: one joint robust solution, starting at the averaged poses of its pairs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.linalg import solveh_banded
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from calgraph.config import Cylinder, People
from calgraph.errors import Rejected
from calgraph.estimation.network.heading_search import search_headings
from calgraph.estimation.network.model_error import estimate_model_error
from calgraph.estimation.network.problem import (
    BodyObservations,
    BodyPath,
    BodyScans,
    NetworkProblem,
    NetworkState,
    WallConstraint,
)
from calgraph.estimation.network.range_noise import estimate_range_noise
from calgraph.estimation.network.scan_equations import compute_tukey_weights
from calgraph.estimation.network.scanner_prior import ScannerPrior
from calgraph.estimation.network.solver import (
    compute_network_covariance,
    compute_residuals,
    compute_smoothness_information,
    evaluate_at,
    optimize_network,
    raycast_body,
)
from calgraph.estimation.network.splines import Knots
from calgraph.estimation.network.track_association import BodyTracks, group_tracks_by_body
from calgraph.geometry import Array, se2
from calgraph.graph import PoseGraph, PoseGraphSolution
from calgraph.pairwise import icp
from calgraph.tracking import ScannerTracks, Track

# Interval of a path's control points, s: a step of a walk takes half a second.
_KNOT_INTERVAL = 0.2
# Prior standard deviation of people's radii, relative to them; and of a cylinder's, m.
_PEOPLE_RADII_SIGMA, _CYLINDER_RADII_SIGMA = 0.3, 1e-4
# Prior standard deviation of the offsets of clocks that are not synchronized, s.
_CLOCK_SIGMA = 0.1
# Standard deviation of paths and radii in the first rounds, m; added to the noise of ranges.
_INITIAL_PATH_SIGMA = (0.05, 0.02)
# Arms are in front of the torso or beside it, never behind. In the first rounds, the limit for beams that end in
# front of the outline is divided by this: an outline that once fits arms would keep them.
_INITIAL_NEAR_SIDE_FACTOR = 2.5
# Start values of the model error: standard deviations of position, m, and heading, rad.
_INITIAL_POSITION_ERROR, _INITIAL_HEADING_ERROR = 0.005, 0.05
# Rounds of noise, weights, model error, walls and solution, until the model error changes by less than this ratio;
# and steps of each solution.
_MAX_ROUNDS = 5
_MODEL_ERROR_TOLERANCE = 0.3
_STEPS = 4
# Noise of tracked positions for the first path, m.
_TRACK_SIGMA = 0.03


@dataclass(frozen=True, eq=False)
class NetworkSolution:
    """The joint solution of a network of S scanners."""

    T_root_scanner: Array
    """(S, 3, 3)."""
    clock_offset: Array
    """(S,) scanner clock minus root clock, s."""
    covariance: Array
    """(4S, 4S) of pose in the root's fixed axes and clock offset, scanner by scanner."""
    clocks_estimated: bool
    """Whether clock offsets were estimated."""
    model_error: float
    """Standard deviation of the position of bodies in a scan about their smooth path, m."""

    @property
    def pose_covariance(self) -> Array:
        """(3S, 3S) of the poses, in the root's fixed axes; zero for the root."""
        poses = np.arange(len(self.covariance)) % 4 < 3
        return self.covariance[np.ix_(poses, poses)]

    @property
    def clocks(self) -> Array:
        """(S, 2) offsets and their standard deviations, s; NaN where they were not estimated, and for the root."""
        clocks = np.column_stack([self.clock_offset, np.sqrt(np.diagonal(self.covariance)[3::4])])
        clocks[slice(0, 1) if self.clocks_estimated else slice(None)] = np.nan
        return clocks


def solve_network(
    target: People | Cylinder,
    tracked: Sequence[ScannerTracks],
    averaged: PoseGraphSolution,
    graph: PoseGraph,
    *,
    estimate_clocks: bool = True,
    prior: ScannerPrior | None = None,
) -> NetworkSolution:
    """Solves jointly for scanner poses, clock offsets, and paths and radii of bodies.

    Args:
        target: the kind of bodies.
        tracked: the tracks of each scanner, the root's first.
        averaged: start poses, and the pairs that are inliers.
        graph: of these pairs.
        estimate_clocks: whether the scanners' clocks may differ.
        prior: of scanner poses, from an earlier calibration.
    """
    T_root_scanner = averaged.T_root_node
    edges = [
        WallConstraint(int(i), int(j), T, information)
        for (i, j), T, information, inlier in zip(
            graph.edges, graph.T_i_j, graph.information, averaged.inliers, strict=True
        )
        if inlier
    ]
    bodies = group_tracks_by_body(tracked, T_root_scanner)
    state = NetworkState(
        T_root_scanner,
        np.zeros(len(tracked)),
        tuple(_initialize_path(body, target, T_root_scanner) for body in bodies),
    )
    background = np.array([scanner.sigma for scanner in tracked])
    network = NetworkProblem(
        len(tracked),
        tuple(_build_observations(body, target) for body in bodies),
        (),
        range_sigma=background,
        model_error_variance=np.array([_INITIAL_POSITION_ERROR, _INITIAL_HEADING_ERROR]) ** 2,
        clock_sigma=_CLOCK_SIGMA if estimate_clocks else 0.0,
        prior=prior,
    )
    network = replace(network, walls=_select_bridges(network, (), edges))
    for path_sigma in _INITIAL_PATH_SIGMA:
        network = replace(network, range_sigma=np.hypot(background, path_sigma))
        network = _update_weights(network, state, _INITIAL_NEAR_SIDE_FACTOR)
        state, equations = optimize_network(network, state, iterations=_STEPS)
        state = search_headings(network, state)
    previous = np.full(2, np.inf)
    for _ in range(_MAX_ROUNDS):
        range_sigma = estimate_range_noise(network, state, equations, background)
        network = _update_weights(replace(network, range_sigma=range_sigma), state)
        network = replace(network, model_error_variance=estimate_model_error(network, state))
        walls = _register_walls(tracked, network, state)
        network = replace(network, walls=(*walls, *_select_bridges(network, walls, edges)))
        state, equations = optimize_network(network, state, iterations=_STEPS)
        if np.all(np.abs(network.model_error_variance / previous - 1) < _MODEL_ERROR_TOLERANCE):
            break
        previous = network.model_error_variance
    return NetworkSolution(
        state.T_root_scanner,
        state.clock_offset,
        compute_network_covariance(network, equations),
        estimate_clocks,
        float(np.sqrt(network.model_error_variance[0])),
    )


def _build_observations(body: BodyTracks, target: People | Cylinder) -> BodyObservations:
    radii = _prior_radii(target)
    sigma = np.full(2, _CYLINDER_RADII_SIGMA) if isinstance(target, Cylinder) else _PEOPLE_RADII_SIGMA * radii
    scans = tuple(_collect_scans(scanner, tracks) for scanner, tracks in sorted(body.by_scanner().items()))
    return BodyObservations(_place_knots(body), scans, radii, sigma, faces_forward=isinstance(target, People))


def _place_knots(body: BodyTracks) -> Knots:
    """Knots that cover the body's tracks, wherever their clocks are."""
    margin = 3 * _CLOCK_SIGMA
    return Knots.spanning(body.start - margin, body.end + margin, _KNOT_INTERVAL)


def _prior_radii(target: People | Cylinder) -> Array:
    return np.array(target.axes) if isinstance(target, People) else np.full(2, target.diameter / 2)


def _collect_scans(scanner: int, tracks: Sequence[Track]) -> BodyScans:
    """All beams of one scanner on one body, by scan in order of time."""
    times, points, beam_times, counts = [], [], [], []
    for track in sorted(tracks, key=lambda track: float(track.times[0])):
        times.append(track.times)
        points.append(track.hits.points)
        beam_times.append(track.hits.times)
        counts.append(np.bincount(track.hits.time_index, minlength=len(track.times)))
    scan_time, point, beam_time = (np.concatenate(part) for part in (times, points, beam_times))
    count = np.concatenate(counts)
    # Tracks of one body may overlap slightly: scans are sorted by time, with their beams.
    order = np.argsort(scan_time, kind="stable")
    start = np.cumsum(count) - count
    beams = np.concatenate([np.arange(start[i], start[i] + count[i]) for i in order])
    ranges = np.linalg.norm(point[beams], axis=1)
    scan = np.repeat(np.arange(len(order)), count[order])
    return BodyScans(
        scanner,
        scan_time[order],
        np.asarray(np.cumsum(count[order]) - count[order], dtype=np.intp),
        point[beams] / ranges[:, None],
        ranges,
        beam_time[beams] - scan_time[order][scan],
        np.ones(len(beams)),
    )


def _initialize_path(body: BodyTracks, target: People | Cylinder, T_root_scanner: Array) -> BodyPath:
    """Smoothing spline through the positions of all tracks, with the heading along the direction of motion."""
    knots = _place_knots(body)
    times = np.concatenate([track.times for _, track in body.tracks])
    positions = np.concatenate([se2.apply(T_root_scanner[s], track.positions) for s, track in body.tracks])
    first, weights, _ = knots.basis_at(times)
    band, right = np.zeros((4, knots.count)), np.zeros((knots.count, 2))
    for i in range(4):
        np.add.at(right, first + i, weights[:, i, None] * positions / _TRACK_SIGMA**2)
        for j in range(i, 4):
            np.add.at(band[j - i], first + i, weights[:, i] * weights[:, j] / _TRACK_SIGMA**2)
    smooth = compute_smoothness_information(_KNOT_INTERVAL)
    for i in range(3):
        for j in range(i, 3):
            band[j - i, i : knots.count - 2 + i] += smooth[i, j]
    band[0] += 1e-9
    control = solveh_banded(band, right, lower=True)
    velocity = np.gradient(control, _KNOT_INTERVAL, axis=0)
    walking = np.linalg.norm(velocity, axis=1) > 0.2
    heading = np.arctan2(velocity[:, 1], velocity[:, 0])
    if walking.any():
        k = np.arange(len(control))
        heading = np.interp(k, k[walking], np.unwrap(heading[walking]))
    return BodyPath(np.column_stack([control, heading]), _prior_radii(target))


def _update_weights(network: NetworkProblem, state: NetworkState, near_side_factor: float = 1.0) -> NetworkProblem:
    """The network with robust weights of beams at a state; ``near_side_factor`` as for the weights."""
    bodies = []
    for body, path in zip(network.bodies, state.paths, strict=True):
        scans = tuple(
            replace(one, weight=_compute_weights(network, state, body, path, one, near_side_factor))
            for one in body.scans
        )
        bodies.append(replace(body, scans=scans))
    return replace(network, bodies=tuple(bodies))


def _compute_weights(
    network: NetworkProblem,
    state: NetworkState,
    body: BodyObservations,
    path: BodyPath,
    scans: BodyScans,
    near_side_factor: float,
) -> Array:
    """(N,)."""
    _, _, pose, rate = evaluate_at(state, body, path, scans)
    hits = raycast_body(state, path, scans, pose, rate)
    residual, _ = compute_residuals(network, scans, hits)
    return compute_tukey_weights(residual, hits.not_grazing, near_side_factor)


def _register_walls(
    tracked: Sequence[ScannerTracks], network: NetworkProblem, state: NetworkState
) -> tuple[WallConstraint, ...]:
    """Registers the static backgrounds of all pairs of scanners that measured a common body."""
    pairs = {
        (a.scanner, b.scanner)
        for body in network.bodies
        for k, a in enumerate(body.scans)
        for b in body.scans[k + 1 :]
    }
    backgrounds = [icp.StaticBackground(scanner.background) for scanner in tracked]
    walls = []
    for a, b in sorted(pairs):
        T_a_b = se2.inverse(state.T_root_scanner[a]) @ state.T_root_scanner[b]
        sigma = float(np.hypot(tracked[a].sigma, tracked[b].sigma))
        registered = icp.align_backgrounds(
            T_a_b, np.diag([0.05**2, 0.05**2, 0.01**2]), backgrounds[a], backgrounds[b], sigma
        )
        if not isinstance(registered, Rejected):
            walls.append(WallConstraint(a, b, registered.T_a_b, registered.information))
    return tuple(walls)


def _select_bridges(
    network: NetworkProblem, walls: Sequence[WallConstraint], edges: Sequence[WallConstraint]
) -> tuple[WallConstraint, ...]:
    """The pairwise edges between parts of the network that neither walls nor beams with a weight connect."""
    scanners = [[scans.scanner for scans in body.scans if scans.weight.any()] for body in network.bodies]
    connected = [pair for of_body in scanners for pair in pairwise(of_body)]
    ends = np.array([*connected, *((wall.a, wall.b) for wall in walls)], dtype=np.intp).reshape(-1, 2)
    adjacency = coo_array((np.ones(len(ends)), ends.T), shape=(network.count, network.count))
    part = connected_components(adjacency, directed=False)[1]
    return tuple(edge for edge in edges if part[edge.a] != part[edge.b])
