"""Constraints between scanners of a network beside common people: registered walls, and edges that bridge gaps."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from calgraph.errors import Rejected
from calgraph.geometry import se2
from calgraph.network.joint.problem import NetworkProblem, NetworkState, WallConstraint
from calgraph.network.joint.scanner_unknowns import correct_points, linearize_beam_errors
from calgraph.network.pairs import icp
from calgraph.network.tracking.track import ScannerTracks
from calgraph.parallel.engine import MapEngine

# Error of the joint poses at which the registration of walls starts, m: bounds which walls correspond.
_WALL_POSITION_SIGMA = 0.05
# The error of the joint poses at which the registration of walls starts, rad.
_WALL_ROTATION_SIGMA = 0.01


def register_walls(
    tracked: Sequence[ScannerTracks], network: NetworkProblem, state: NetworkState, engine: MapEngine
) -> tuple[WallConstraint, ...]:
    """Registers the static backgrounds of all pairs of scanners that measured a common body.

    Args:
        tracked: the tracks of each scanner, with its background.
        network: with the bodies.
        state: whose poses and systematic errors the registration starts from.
        engine: evaluates pairs.
    """
    pairs = {
        (a.scanner, b.scanner)
        for body in network.bodies
        for k, a in enumerate(body.scans)
        for b in body.scans[k + 1 :]
    }
    pass
    prior_covariance = np.diag(np.square([_WALL_POSITION_SIGMA, _WALL_POSITION_SIGMA, _WALL_ROTATION_SIGMA]))
    beam_errors, _ = linearize_beam_errors(state.systematic)
    backgrounds = engine.put(
        [
            icp.StaticBackground(correct_points(scanner.background, errors))
            for scanner, errors in zip(tracked, state.systematic, strict=True)
        ]
    )
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
    adjacency = coo_array((np.ones(len(ends)), ends.T), shape=(network.count, network.count))
    part = connected_components(adjacency, directed=False)[1]
    return tuple(edge for edge in edges if part[edge.a] != part[edge.b])
