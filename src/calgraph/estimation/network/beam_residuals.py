"""Residuals of all beams of a network's joint solution."""

from collections.abc import Iterator
from dataclasses import dataclass

from calgraph.estimation.network.leg_equations import compute_leg_residuals, raycast_leg
from calgraph.estimation.network.leg_problem import LegPath
from calgraph.estimation.network.path_equations import evaluate_at, index_scans
from calgraph.estimation.network.problem import NetworkProblem, NetworkState
from calgraph.estimation.network.solver import compute_residuals, raycast_body
from calgraph.geometry import Array, Index


@dataclass(frozen=True, eq=False)
class BeamResiduals:
    """Residuals of one scanner's beams on one body."""

    scanner: int
    residual: Array
    """(N,) whitened, in the order of the beams."""
    weight: Array
    """(N,) robust weights."""
    scan: Index
    """(N,) index of each beam's scan, ascending."""


def list_beam_residuals(network: NetworkProblem, state: NetworkState) -> Iterator[BeamResiduals]:
    """The residuals at a state, by body and scanner."""
    for body, path in zip(network.bodies, state.paths, strict=True):
        for k, scans in enumerate(body.scans):
            _, _, pose, rate = evaluate_at(network, state, body, path, scans)
            if isinstance(path, LegPath):
                hits = raycast_leg(network, state, path, scans, pose, rate)
                residual, _ = compute_leg_residuals(network, scans, hits, float(path.bias[k]))
            else:
                residual, _ = compute_residuals(network, scans, raycast_body(state, path, scans, pose, rate))
            yield BeamResiduals(scans.scanner, residual, scans.weight, index_scans(scans))
