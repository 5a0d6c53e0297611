"""Residuals of all beams of a network's joint solution."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array, Index
from calgraph.network.joint.ellipse_equations import compute_residuals, raycast_body
from calgraph.network.joint.leg_equations import compute_leg_residuals, raycast_leg
from calgraph.network.joint.leg_problem import LegPath
from calgraph.network.joint.path_equations import evaluate_at, index_scans
from calgraph.network.joint.problem import BodyObservations, BodyPath, BodyScans, NetworkProblem, NetworkState


@dataclass(frozen=True, eq=False)
class BeamResiduals:
    """Residuals of one scanner's beams on one body."""

    scans: BodyScans
    """The beams."""
    residual: Array
    """(N,) predicted minus measured range, whitened."""
    sigma: Array
    """(N,) standard deviations of ranges, m."""
    scan: Index
    """(N,) index of each beam's scan, ascending."""


def list_beam_residuals(
    network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath
) -> Iterator[BeamResiduals]:
    """The residuals of a body at a state, by scanner."""
    for k, scans in enumerate(body.scans):
        _, _, pose, rate = evaluate_at(network, state, body, path, scans)
        if isinstance(path, LegPath):
            hits = raycast_leg(state, path, scans, pose, rate)
            residual, sigma = compute_leg_residuals(network, scans, hits, float(path.bias[k]))
        else:
            residual, _ = compute_residuals(network, scans, raycast_body(state, path, scans, pose, rate))
            sigma = np.full(len(residual), network.range_sigma[scans.scanner])
        yield BeamResiduals(scans, residual, sigma, index_scans(scans))
