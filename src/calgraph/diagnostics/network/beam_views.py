"""Residuals of the beams of a network's joint solution, for the report."""

from collections.abc import Sequence

import numpy as np

from calgraph.estimation.network.beam_residuals import BeamResiduals, list_beam_residuals
from calgraph.estimation.network.estimate import NetworkSolution
from calgraph.estimation.network.problem import BodyObservations, BodyPath, NetworkProblem, NetworkState
from calgraph.geometry import Array
from calgraph.result import BeamView, FitError
from calgraph.result.evidence import rms

# Beams that are kept of a scanner, and in all: more do not change what a picture shows.
_MAX_BEAMS, _MAX_BEAMS_IN_ALL = 3000, 60_000


def collect_beam_views(
    joint: NetworkSolution, names: Sequence[str], start: float
) -> tuple[tuple[BeamView, ...], dict[str, FitError]]:
    """Residuals of each scanner's inlier beams, thinned for pictures, and their number and RMS.

    Args:
        joint: the joint solution.
        names: of its scanners.
        start: of the recording by the root's clock, s.
    """
    if joint.solved is None:
        return (), {}
    by_scanner: dict[int, list[Array]] = {}
    solved = joint.solved
    for of_body in solved.equations.batches.map(_list_inlier_rows, solved.problem, solved.state):
        for scanner, rows in of_body:
            by_scanner.setdefault(scanner, []).append(rows)
    limit = min(_MAX_BEAMS, _MAX_BEAMS_IN_ALL // max(len(by_scanner), 1))
    views, fit = [], {}
    for scanner, parts in sorted(by_scanner.items()):
        rows = np.concatenate(parts)
        error = rms(rows[:, 3])
        if error is not None:
            rows = rows[np.argsort(rows[:, 0], kind="stable")]
            fit[names[scanner]] = FitError(len(rows), "m", error)
            rows = rows[:: len(rows) // limit + 1]
            times = rows[:, 0] - float(joint.clock_offset[scanner]) - start
            views.append(BeamView(names[scanner], times, rows[:, 1:3], rows[:, 3]))
    return tuple(views), fit


def _list_inlier_rows(
    network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath
) -> list[tuple[int, Array]]:
    """The rows of each scanner's inlier beams on a body."""
    residuals = list_beam_residuals(network, state, body, path)
    return [(beams.scans.scanner, _inlier_rows(beams)) for beams in residuals]


def _inlier_rows(beams: BeamResiduals) -> Array:
    """(N, 4) time by the scanner's clock, end of the beam, and measured minus predicted range."""
    scans = beams.scans
    time = scans.times[beams.scan] + scans.beam_delay
    residual = -beams.residual * beams.sigma
    rows = np.column_stack([time, scans.direction * scans.ranges[:, None], residual])
    return rows[scans.weight > 0]
