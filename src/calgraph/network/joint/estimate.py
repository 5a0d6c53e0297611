"""The default estimator of a network: one joint robust solution, starting at the averaged poses of its pairs."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.linalg import solveh_banded

from calgraph.config import Cylinder, Lidar2dUncertainty, People
from calgraph.config.settings import NetworkEstimationSettings, TrackingSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array, se2
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.network.joint.body_batches import BodyBatches
from calgraph.network.joint.body_equations import update_weights
from calgraph.network.joint.ellipses import MIN_WALKING_SPEED, EllipseObservations, search_headings
from calgraph.network.joint.leg_solution import SECOND_PATH_SIGMA, AddWalls, solve_legs
from calgraph.network.joint.legs import measures_legs
from calgraph.network.joint.model_error import estimate_model_error
from calgraph.network.joint.path_equations import compute_smoothness_information
from calgraph.network.joint.planar_poses import NearCovariances, ScannerPrior
from calgraph.network.joint.problem import (
    BodyObservations,
    BodyPath,
    BodyScans,
    NetworkProblem,
    NetworkState,
    WallConstraint,
)
from calgraph.network.joint.range_noise import estimate_range_noise
from calgraph.network.joint.scanner_unknowns import (
    CLOCK,
    FIRST_SYSTEMATIC,
    SYSTEMATIC_ERRORS,
    SystematicErrors,
    collect_prior_sigma,
    correct_points,
    linearize_beam_errors,
)
from calgraph.network.joint.solver import (
    NetworkEquations,
    compute_network_covariance,
    list_known_pairs,
    optimize_network,
)
from calgraph.network.joint.splines import Knots
from calgraph.network.joint.systematic_spread import estimate_systematic_sigma
from calgraph.network.joint.track_association import BodyTracks, cut_bodies, group_tracks_by_body
from calgraph.network.pairs import icp
from calgraph.network.pairs.scanner_pair import CLOCK_SIGMA
from calgraph.network.tracking.track import ScannerTracks, Track
from calgraph.parallel.engine import THIS_PROCESS, MapEngine
from calgraph.parallel.kept_values import Kept
from calgraph.parallel.mapped_arrays import ArrayMemory
from calgraph.solver.connected_parts import label_parts

# People whose beams are in one file, if they are not in memory: systems allow tens of thousands of mapped files.
_BODIES_PER_FILE = 100


@dataclass(frozen=True, eq=False)
class NetworkSolution:
    """The joint solution of a network of S scanners."""

    T_root_scanner: Array
    """(S, 3, 3)."""
    clock_offset: Array
    """(S,) scanner clock minus root clock in the middle of the recording, s."""
    covariance: NearCovariances
    """Of pose in the root's fixed axes and clock offset; unknown between scanners of a large network that have no
    common body or wall."""
    solved: NetworkEquations | None = None
    """At the minimum, with the noise, model error and robust weights of the last round, for tests of the solution;
    None where only the result is given."""
    systematic: SystematicErrors | None = None
    """Systematic errors of the scanners."""
    variance_factors: tuple[tuple[str, Array], ...] = ()
    """Factors (S,) of the covariance that are not of the solution, one after the other, and what they contain."""

    @property
    def pose_covariance(self) -> Array:
        """(3S, 3S) of the poses, in the root's fixed axes; zero for the root, NaN where it is unknown."""
        covariance = self.covariance.select_errors(np.arange(3)).expand()
        covariance[:3] = covariance[:, :3] = 0.0
        return covariance

    def scale_covariance(self, factor: float | Array, source: str) -> "NetworkSolution":
        """The solution with variances that are larger by a factor, or by one of each scanner (S,), and why."""
        factors = (*self.variance_factors, (source, np.broadcast_to(factor, self.covariance.count)))
        return replace(self, covariance=self.covariance.scale(factor), variance_factors=factors)

    @property
    def clocks(self) -> Array:
        """(S, 2) offsets and their standard deviations, s; NaN for the root."""
        clocks = np.column_stack([self.clock_offset, self.covariance.stddev[:, CLOCK]])
        clocks[0] = np.nan
        return clocks


# Standard deviation of a body's position in the first two solutions, m. Later ones estimate it wherever two
# scanners measure a body together.
_INITIAL_POSITION_SIGMA = 0.005
# The same of a body's heading, rad.
_INITIAL_HEADING_SIGMA = 0.05


def solve_network(
    target: People | Cylinder,
    tracked: Sequence[ScannerTracks],
    averaged: PoseGraphSolution,
    graph: PoseGraph,
    *,
    uncertainties: Sequence[Lidar2dUncertainty] = (),
    prior: ScannerPrior | None = None,
    settings: NetworkEstimationSettings,
    acceleration_density: float = TrackingSettings().acceleration_density,
    engine: MapEngine = THIS_PROCESS,
) -> NetworkSolution:
    """Solves jointly for poses, clocks and systematic errors of scanners, and paths and radii of bodies.

    Args:
        target: the kind of bodies.
        tracked: the tracks of each scanner, the root's first.
        averaged: start poses, and the pairs that are inliers.
        graph: of these pairs.
        uncertainties: prior standard deviations of systematic errors of each scanner; the defaults if left out.
        prior: of scanner poses, from an earlier calibration.
        settings: of the estimate.
        acceleration_density: spectral density of a body's acceleration, m²/s³.
        engine: evaluates bodies and walls; does not affect the result.
    """
    T_root_scanner = averaged.T_root_node
    edges = [
        WallConstraint(int(i), int(j), T, information)
        for (i, j), T, information, inlier in zip(
            graph.edges, graph.T_i_j, graph.information, averaged.inliers, strict=True
        )
        if inlier
    ]
    walks = group_tracks_by_body(tracked, T_root_scanner)
    bodies = cut_bodies(walks)
    state = NetworkState(
        T_root_scanner,
        np.zeros(len(tracked)),
        np.zeros((len(tracked), len(SYSTEMATIC_ERRORS))),
        tuple(_initialize_path(body, target, T_root_scanner, acceleration_density) for body in bodies),
    )
    background = np.array([scanner.sigma for scanner in tracked])
    prior_sigma = collect_prior_sigma(uncertainties or [Lidar2dUncertainty()] * len(tracked))
    network = NetworkProblem(
        len(tracked),
        tuple(_observe_bodies(bodies, target, settings)),
        (),
        range_sigma=background,
        model_error_variance=np.array([_INITIAL_POSITION_SIGMA, _INITIAL_HEADING_SIGMA]) ** 2,
        systematic_sigma=prior_sigma,
        mid_time=(bodies[0].start + max(body.end for body in bodies)) / 2 if bodies else 0.0,
        acceleration_density=acceleration_density,
        settings=settings,
        prior=prior,
    )

    def add_walls(network: NetworkProblem, state: NetworkState) -> NetworkProblem:
        walls = register_walls(tracked, network, state, engine)
        return replace(network, walls=(*walls, *select_bridges(network, walls, edges)))

    foregrounds = [one.foreground for one in tracked if one.foreground is not None]
    if (
        isinstance(target, People)
        and len(foregrounds) == len(tracked)
        and measures_legs(target, tracked, settings.legs)
    ):
        equations = solve_legs(network, state, foregrounds, add_walls, engine)
    else:
        equations = _solve_bodies(network, state, edges, add_walls, engine)
    network, state = equations.network, equations.state
    covariance, pairs = compute_network_covariance(equations), list_known_pairs(network)
    return NetworkSolution(
        state.T_root_scanner,
        state.clock_offset,
        covariance.select_pairs(pairs, slice(FIRST_SYSTEMATIC)),
        solved=equations,
        systematic=SystematicErrors(
            state.systematic, covariance.select_pairs(pairs, slice(FIRST_SYSTEMATIC, None)), prior_sigma
        ),
    )


# Error of paths and radii before the first solution, m; added to the noise of ranges. It is that of averaged
# poses and tracked centres.
_FIRST_PATH_SIGMA = 0.05
# In the first rounds, the limit is divided by this for beams that end in front of the outline. Arms are in front
# of the torso or next to it, never behind, and an outline that is fitted to arms keeps them.
_INITIAL_NEAR_SIDE_FACTOR = 2.5
# Levenberg–Marquardt steps of each solution: weights and noise change between solutions, so that none needs to
# converge.
_ITERATIONS = 4
# Rounds of noise, weights, model error, walls and solution. Over 21 simulated offices, halls and labs, two rounds
# give a NEES of 0.59, five 0.96, and ten change nothing.
_MAX_ROUNDS = 5
# Relative change of the variances at which the rounds end: 15 % of a standard deviation, less than its
# uncertainty from a minute of one person.
_TOLERANCE = 0.3
# The gain that the next step is predicted to have, in half squared standard deviations, at which the last round
# ends: no unknown is then off by more than 4 % of its standard deviation.
_FINAL_TOLERANCE = 1e-3
# Share of the cost that the next step of a round is predicted to gain, at which all but the last round end: about
# two steps. The changes of weights and noise from one round to the next are several times larger.
_ROUND_TOLERANCE = 5e-5
# The same in the rounds, which start near their minimum: 1e-3 of the large diagonal of a smooth path slows down
# what scanners have in common, such as the bend of a long row. With 1e-6, poses of a row of 30 are 0.09 standard
# deviations from their minimum.
_ROUND_DAMPING = 1e-8


def _solve_bodies(
    network: NetworkProblem,
    state: NetworkState,
    edges: Sequence[WallConstraint],
    add_walls: AddWalls,
    engine: MapEngine,
) -> NetworkEquations:
    """Solves for scanners and ellipses, from the noise of the background and the priors of rig.yaml."""
    background, prior_sigma = network.range_sigma, network.systematic_sigma
    network = replace(network, walls=select_bridges(network, (), edges))
    batches = BodyBatches.place(network.bodies, engine)
    for path_sigma in (_FIRST_PATH_SIGMA, SECOND_PATH_SIGMA):
        network = replace(network, range_sigma=np.hypot(background, path_sigma))
        network, batches = update_weights(network, state, batches, _INITIAL_NEAR_SIDE_FACTOR)
        state, equations = optimize_network(network, state, iterations=_ITERATIONS, batches=batches)
        state = search_headings(network, state, batches)
    previous = np.full(2, np.inf)
    for rounds_left in reversed(range(_MAX_ROUNDS)):
        range_sigma = estimate_range_noise(network, state, equations, background)
        network, batches = update_weights(replace(network, range_sigma=range_sigma), state, batches)
        network = replace(
            network,
            model_error_variance=estimate_model_error(network, state, batches),
            systematic_sigma=estimate_systematic_sigma(equations, prior_sigma, engine),
        )
        change = np.abs(network.model_error_variance / previous - 1)
        last = rounds_left == 0 or bool(np.all(change < _TOLERANCE))
        network = add_walls(network, state)
        state, equations = optimize_network(
            network,
            state,
            iterations=_ITERATIONS,
            tolerance=_FINAL_TOLERANCE,
            relative_tolerance=0.0 if last else _ROUND_TOLERANCE,
            damping=_ROUND_DAMPING,
            batches=batches,
        )
        if last:
            break
        previous = network.model_error_variance
    return equations


def _observe_bodies(
    bodies: Sequence[BodyTracks], target: People | Cylinder, settings: NetworkEstimationSettings
) -> Iterator[BodyObservations]:
    """The beams of all bodies, with limited memory."""
    memory = ArrayMemory(settings.max_kept_bytes)
    for first in range(0, len(bodies), _BODIES_PER_FILE):
        selected = bodies[first : first + _BODIES_PER_FILE]
        yield from memory.limit([_build_observations(body, target) for body in selected])


# Prior standard deviation of people's radii, relative to those of rig.yaml: shoulder breadths of adults vary by
# 15 %, and clothes and the height of the scanning plane as much.
_PEOPLE_RADII_SIGMA = 0.3
# Prior standard deviation of a cylinder's radius, m: its diameter is measured with a tape to 0.2 mm.
_CYLINDER_RADIUS_SIGMA = 1e-4


def _build_observations(body: BodyTracks, target: People | Cylinder) -> EllipseObservations:
    radii = _prior_radii(target)
    people = isinstance(target, People)
    sigma = _PEOPLE_RADII_SIGMA * radii if people else np.full(2, _CYLINDER_RADIUS_SIGMA)
    scans = tuple(collect_scans(scanner, tracks) for scanner, tracks in sorted(body.by_scanner().items()))
    return EllipseObservations(_place_knots(body), scans, radii, sigma, faces_forward=people)


# Interval of a path's control points, s: two or three for a step of half a second, the fastest motion of a torso.
_KNOT_INTERVAL = 0.2


def _place_knots(body: BodyTracks) -> Knots:
    """Knots that cover the body's tracks for clock offsets of up to three standard deviations."""
    margin = 3 * CLOCK_SIGMA
    return Knots.spanning(body.start - margin, body.end + margin, _KNOT_INTERVAL)


def _prior_radii(target: People | Cylinder) -> Array:
    return np.array(target.axes) if isinstance(target, People) else np.full(2, target.diameter / 2)


def collect_scans(scanner: int, tracks: Sequence[Track]) -> BodyScans:
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


# Noise of tracked positions in the first path, m: that of ellipse centres at a few metres' range.
_TRACK_SIGMA = 0.03


def _initialize_path(
    body: BodyTracks, target: People | Cylinder, T_root_scanner: Array, acceleration_density: float
) -> BodyPath:
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
    smooth = compute_smoothness_information(knots.step, acceleration_density)
    for i in range(3):
        for j in range(i, 3):
            band[j - i, i : knots.count - 2 + i] += smooth[i, j]
    # Makes knots without positions invertible; the smoothness determines them.
    band[0] += 1e-9
    control = solveh_banded(band, right, lower=True)
    velocity = np.gradient(control, knots.step, axis=0)
    walking = np.linalg.norm(velocity, axis=1) > MIN_WALKING_SPEED
    heading = np.arctan2(velocity[:, 1], velocity[:, 0])
    if walking.any():
        k = np.arange(len(control))
        heading = np.interp(k, k[walking], np.unwrap(heading[walking]))
    return BodyPath(np.column_stack([control, heading]), _prior_radii(target))


# Error of the joint poses at which the registration of walls starts, m: bounds which walls correspond.
_WALL_POSITION_SIGMA = 0.05
# The error of the joint poses at which the registration of walls starts, rad.
_WALL_ROTATION_SIGMA = 0.01


def register_walls(
    tracked: Sequence[ScannerTracks], network: NetworkProblem, state: NetworkState, engine: MapEngine
) -> tuple[WallConstraint, ...]:
    """Registers the static backgrounds of all pairs of scanners that measured a common body.

    Registration starts from the poses and systematic errors of ``state``.
    """
    pairs = {
        (a.scanner, b.scanner)
        for body in network.bodies
        for k, a in enumerate(body.scans)
        for b in body.scans[k + 1 :]
    }
    prior_covariance = np.diag(np.square([_WALL_POSITION_SIGMA, _WALL_POSITION_SIGMA, _WALL_ROTATION_SIGMA]))
    beam_errors, _ = linearize_beam_errors(state.systematic)
    backgrounds = [
        Kept.of(icp.StaticBackground(correct_points(scanner.background, errors)))
        for scanner, errors in zip(tracked, state.systematic, strict=True)
    ]
    work = []
    for a, b in sorted(pairs):
        T_a_b = se2.inverse(state.T_root_scanner[a]) @ state.T_root_scanner[b]
        sigma = float(np.hypot(tracked[a].sigma, tracked[b].sigma))
        work.append((T_a_b, prior_covariance, backgrounds[a], backgrounds[b], sigma))
    walls = []
    for (a, b), registered in zip(sorted(pairs), engine.map(icp.align_backgrounds, work), strict=True):
        if not isinstance(registered, Rejected):
            by_errors = registered.by_beam_errors
            # The pose that exact ranges and angles would have given.
            T_a_b = se2.retract(registered.T_a_b, -by_errors @ beam_errors[[a, b]].ravel())
            walls.append(WallConstraint(a, b, T_a_b, registered.information, by_errors))
    return tuple(walls)


def select_bridges(
    network: NetworkProblem, walls: Sequence[WallConstraint], edges: Sequence[WallConstraint]
) -> tuple[WallConstraint, ...]:
    """The pairwise edges between parts of the network that neither walls nor beams with a weight connect."""
    scanners = [[scans.scanner for scans in body.scans if scans.weight.any()] for body in network.bodies]
    connected = [pair for of_body in scanners for pair in pairwise(of_body)]
    ends = np.array([*connected, *((wall.a, wall.b) for wall in walls)], dtype=np.intp).reshape(-1, 2)
    part = label_parts(network.count, ends)
    return tuple(edge for edge in edges if part[edge.a] != part[edge.b])
