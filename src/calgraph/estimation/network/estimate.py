"""The default estimator of a network: everything at once, from where averaging its pairs put the scanners."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.linalg import solveh_banded
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from calgraph.config import Cylinder, People
from calgraph.errors import Rejected
from calgraph.estimation.network.heading_search import with_best_headings
from calgraph.estimation.network.model_error import measured_sway
from calgraph.estimation.network.range_noise import measured_noise
from calgraph.estimation.network.scan_equations import robust_weights
from calgraph.estimation.network.scanner_prior import ScannerPrior
from calgraph.estimation.network.solver import (
    Body,
    Glimpses,
    Motion,
    Network,
    State,
    Wall,
    along,
    covariance,
    outlines,
    residuals,
    solve,
    straightness,
)
from calgraph.estimation.network.splines import Knots
from calgraph.estimation.network.track_association import Walker, scanners_of, walkers
from calgraph.geometry import Array, se2
from calgraph.graph import PoseGraph, PoseGraphSolution
from calgraph.pairwise import icp
from calgraph.tracking import Track, Tracked

# Control points of a path are this far apart, s: a step of a walk takes half a second.
_KNOTS = 0.2
# How well people's radii are known beforehand, as a part of themselves; a cylinder's, m.
_BODIES, _CYLINDER = 0.3, 1e-4
# Clocks that nobody set are off by about this, s.
_CLOCKS = 0.1
# By how much paths and sizes are off in the beginning, round after round, m.
_ROUGH = (0.05, 0.02)
# Arms are before a torso or beside it, never behind. While paths are rough, beams that end before the outline are
# out of it so many times sooner; an outline that took arms in once would keep them.
_BEFORE = 2.5
# A body's place strays from its smooth path by so much to begin with, m; and its heading, rad.
_SWAY, _TWIST = 0.005, 0.05
# Rounds of choosing beams, matching walls anew, measuring the sway and solving, until the sway changes by less
# than a share of itself; and steps in each.
_ROUNDS = 5
_SETTLED = 0.3
_STEPS = 4
# First guess of a path: noise of tracked places, m.
_NOISE = 0.03


@dataclass(frozen=True, eq=False)
class JointNetwork:
    """The joint solution of a network."""

    T_root_scanner: Array
    """(S, 3, 3)."""
    offset: Array
    """(S,) scanner clock minus root clock, s."""
    covariance: Array
    """(4S, 4S) of pose in the root's fixed axes and clock offset, scanner by scanner."""
    clocks_free: bool
    """Whether clock offsets were estimated."""
    sway: float
    """How far bodies stray from ellipses on smooth paths from scan to scan, standard deviation, m."""

    @property
    def pose_covariance(self) -> Array:
        """(3S, 3S) of the poses alone, in the root's fixed axes; zero for the root."""
        poses = np.arange(len(self.covariance)) % 4 < 3
        return self.covariance[np.ix_(poses, poses)]

    @property
    def clocks(self) -> Array:
        """(S, 2) offsets and their standard deviations, s; NaN where they were not estimated, and for the root."""
        clocks = np.column_stack([self.offset, np.sqrt(np.diagonal(self.covariance)[3::4])])
        clocks[slice(0, 1) if self.clocks_free else slice(None)] = np.nan
        return clocks


def solve_network(
    target: People | Cylinder,
    tracked: Sequence[Tracked],
    averaged: PoseGraphSolution,
    graph: PoseGraph,
    *,
    clocks: bool = True,
    prior: ScannerPrior | None = None,
) -> JointNetwork:
    """Solves for scanners, clocks, paths and sizes at once.

    Args:
        target: what walks.
        tracked: what each scanner followed, the root first.
        averaged: start poses, and the pairs that agree with them.
        graph: of these pairs.
        clocks: whether the scanners' clocks may differ.
        prior: what an earlier calibration says.
    """
    T_root_scanner = averaged.T_root_node
    edges = [
        Wall(int(i), int(j), T, information)
        for (i, j), T, information, agrees in zip(
            graph.edges, graph.T_i_j, graph.information, averaged.inliers, strict=True
        )
        if agrees
    ]
    bodies = walkers(tracked, T_root_scanner)
    state = State(
        T_root_scanner,
        np.zeros(len(tracked)),
        tuple(_first_motion(walker, target, T_root_scanner) for walker in bodies),
    )
    background = np.array([known.sigma for known in tracked])
    network = Network(
        len(tracked),
        tuple(_body(walker, target) for walker in bodies),
        (),
        sigma=background,
        sway=np.array([_SWAY, _TWIST]) ** 2,
        clock_sigma=_CLOCKS if clocks else 0.0,
        prior=prior,
    )
    network = replace(network, walls=_bridging(network, (), edges))
    for rough in _ROUGH:
        network = _with_beams(replace(network, sigma=np.hypot(background, rough)), state, _BEFORE)
        state, system = solve(network, state, iterations=_STEPS)
        state = with_best_headings(network, state)
    measured = np.full(2, np.inf)
    for _ in range(_ROUNDS):
        sigma = measured_noise(network, state, system, background)
        network = _with_beams(replace(network, sigma=sigma), state)
        network = replace(network, sway=measured_sway(network, state))
        walls = _walls(tracked, network, state)
        network = replace(network, walls=(*walls, *_bridging(network, walls, edges)))
        state, system = solve(network, state, iterations=_STEPS)
        if np.all(np.abs(network.sway / measured - 1) < _SETTLED):
            break
        measured = network.sway
    return JointNetwork(
        state.T_root_scanner,
        state.offset,
        covariance(network, system),
        clocks,
        float(np.sqrt(network.sway[0])),
    )


def _body(walker: Walker, target: People | Cylinder) -> Body:
    radii = _radii(target)
    sigma = np.full(2, _CYLINDER) if isinstance(target, Cylinder) else _BODIES * radii
    glimpses = tuple(_glimpses(scanner, tracks) for scanner, tracks in sorted(scanners_of(walker).items()))
    margin = 3 * _CLOCKS
    knots = Knots.over(walker.start - margin, walker.end + margin, _KNOTS)
    return Body(knots, glimpses, radii, sigma, faces=isinstance(target, People))


def _radii(target: People | Cylinder) -> Array:
    return np.array(target.axes) if isinstance(target, People) else np.full(2, target.diameter / 2)


def _glimpses(scanner: int, tracks: Sequence[Track]) -> Glimpses:
    """All beams of one scanner on one body, scan by scanner in order of time."""
    times, points, beam_times, counts = [], [], [], []
    for track in sorted(tracks, key=lambda track: float(track.times[0])):
        times.append(track.times)
        points.append(track.hits.points)
        beam_times.append(track.hits.times)
        counts.append(np.bincount(track.hits.owner, minlength=len(track.times)))
    at, hit, when = (np.concatenate(part) for part in (times, points, beam_times))
    count = np.concatenate(counts)
    # Tracks of one body that overlap by a moment are brought in order, beams and all.
    order = np.argsort(at, kind="stable")
    start = np.cumsum(count) - count
    beams = np.concatenate([np.arange(start[i], start[i] + count[i]) for i in order])
    ranges = np.linalg.norm(hit[beams], axis=1)
    view = np.repeat(np.arange(len(order)), count[order])
    return Glimpses(
        scanner,
        at[order],
        np.asarray(np.cumsum(count[order]) - count[order], dtype=np.intp),
        hit[beams] / ranges[:, None],
        ranges,
        when[beams] - at[order][view],
        np.ones(len(beams)),
    )


def _first_motion(walker: Walker, target: People | Cylinder, T_root_scanner: Array) -> Motion:
    """A smooth path through the places that all tracks show, facing where it leads."""
    margin = 3 * _CLOCKS
    knots = Knots.over(walker.start - margin, walker.end + margin, _KNOTS)
    times = np.concatenate([track.times for _, track in walker.tracks])
    places = np.concatenate([se2.apply(T_root_scanner[s], track.positions) for s, track in walker.tracks])
    first, weights, _ = knots.at(times)
    band, right = np.zeros((4, knots.count)), np.zeros((knots.count, 2))
    for i in range(4):
        np.add.at(right, first + i, weights[:, i, None] * places / _NOISE**2)
        for j in range(i, 4):
            np.add.at(band[j - i], first + i, weights[:, i] * weights[:, j] / _NOISE**2)
    straight = straightness(_KNOTS)
    for i in range(3):
        for j in range(i, 3):
            band[j - i, i : knots.count - 2 + i] += straight[i, j]
    band[0] += 1e-9
    path = solveh_banded(band, right, lower=True)
    velocity = np.gradient(path, _KNOTS, axis=0)
    walking = np.linalg.norm(velocity, axis=1) > 0.2
    heading = np.arctan2(velocity[:, 1], velocity[:, 0])
    if walking.any():
        k = np.arange(len(path))
        heading = np.interp(k, k[walking], np.unwrap(heading[walking]))
    return Motion(np.column_stack([path, heading]), _radii(target))


def _with_beams(network: Network, state: State, before: float = 1.0) -> Network:
    """The network with weights of beams: none where they do not meet their body well, or are not of it.

    ``before`` as in :func:`robust_weights`.
    """
    bodies = []
    for body, motion in zip(network.bodies, state.motions, strict=True):
        glimpses = tuple(
            replace(one, weight=_weight(network, state, body, motion, one, before)) for one in body.glimpses
        )
        bodies.append(replace(body, glimpses=glimpses))
    return replace(network, bodies=tuple(bodies))


def _weight(network: Network, state: State, body: Body, motion: Motion, one: Glimpses, before: float) -> Array:
    """(N,)."""
    _, _, pose, rate = along(state, body, motion, one)
    hits = outlines(state, motion, one, pose, rate)
    residual, _ = residuals(network, one, hits)
    return robust_weights(residual, hits.squarely, before)


def _walls(tracked: Sequence[Tracked], network: Network, state: State) -> tuple[Wall, ...]:
    """What the static backgrounds of scanners that saw one body together say of each other."""
    pairs = {
        (a.scanner, b.scanner)
        for body in network.bodies
        for k, a in enumerate(body.glimpses)
        for b in body.glimpses[k + 1 :]
    }
    backgrounds = [icp.StaticBackground(known.background) for known in tracked]
    found = []
    for a, b in sorted(pairs):
        T_a_b = se2.inverse(state.T_root_scanner[a]) @ state.T_root_scanner[b]
        sigma = float(np.hypot(tracked[a].sigma, tracked[b].sigma))
        matched = icp.align_backgrounds(
            T_a_b, np.diag([0.05**2, 0.05**2, 0.01**2]), backgrounds[a], backgrounds[b], sigma
        )
        if not isinstance(matched, Rejected):
            found.append(Wall(a, b, matched.T_a_b, matched.information))
    return tuple(found)


def _bridging(network: Network, walls: Sequence[Wall], edges: Sequence[Wall]) -> tuple[Wall, ...]:
    """Those edges that connect scanners which neither walls nor beams that count do."""
    seen_by = [[one.scanner for one in body.glimpses if one.weight.any()] for body in network.bodies]
    together = [pair for scanners in seen_by for pair in pairwise(scanners)]
    ends = np.array([*together, *((wall.a, wall.b) for wall in walls)], dtype=np.intp).reshape(-1, 2)
    adjacency = coo_array((np.ones(len(ends)), ends.T), shape=(network.count, network.count))
    part = connected_components(adjacency, directed=False)[1]
    return tuple(edge for edge in edges if part[edge.a] != part[edge.b])
