"""Residuals of the beams of a network's joint solution, for the report."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from calgraph.geometry import Array, Index
from calgraph.network.joint.beam_residuals import BeamResiduals, list_beam_residuals
from calgraph.network.joint.estimate import NetworkSolution
from calgraph.network.joint.problem import BodyObservations, BodyPath, NetworkProblem, NetworkState
from calgraph.result import BeamView, FitError

# Beams that are kept of a scanner, and in all: more do not change what a picture shows.
_MAX_BEAMS, _MAX_BEAMS_IN_ALL = 3000, 60_000
# That are collected for each of these at least, if a scanner has as many.
_ROWS_PER_BEAM = 4


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
    solved = joint.solved
    measured = solved.problem.count_beams()
    limit = min(_MAX_BEAMS, _MAX_BEAMS_IN_ALL // max(int(np.count_nonzero(measured)), 1))
    # Rows of one body are in order of time, those of all are not: each scanner's are thinned again.
    list_rows = partial(_list_inlier_rows, step=1 + measured // (_ROWS_PER_BEAM * limit))
    by_scanner: dict[int, list[tuple[int, float, Array]]] = {}
    for of_body in solved.equations.batches.map(list_rows, solved.problem, solved.state):
        for scanner, *of_scanner in of_body:
            by_scanner.setdefault(scanner, []).append(of_scanner)
    views, fit = [], {}
    for scanner, parts in sorted(by_scanner.items()):
        counts, squares, thinned = zip(*parts, strict=True)
        if count := sum(counts):
            rows = np.concatenate(thinned)
            fit[names[scanner]] = FitError(count, "m", float(np.sqrt(sum(squares) / count)))
            rows = rows[np.argsort(rows[:, 0], kind="stable")]
            rows = rows[:: len(rows) // limit + 1]
            times = rows[:, 0] - float(joint.clock_offset[scanner]) - start
            views.append(BeamView(names[scanner], times, rows[:, 1:3], rows[:, 3]))
    return tuple(views), fit


def _list_inlier_rows(
    network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath, step: Index
) -> list[tuple[int, int, float, Array]]:
    """Each scanner's inlier beams on a body: their number, sum of squared residuals, and every n-th (S,) row."""
    listed = []
    for beams in list_beam_residuals(network, state, body, path):
        rows = _inlier_rows(beams)
        scanner = beams.scans.scanner
        listed.append((scanner, len(rows), float(rows[:, 3] @ rows[:, 3]), rows[:: step[scanner]].copy()))
    return listed


def _inlier_rows(beams: BeamResiduals) -> Array:
    """(N, 4) time by the scanner's clock, end of the beam, and measured minus predicted range."""
    scans = beams.scans
    time = scans.times[beams.scan] + scans.beam_delay
    residual = -beams.residual * beams.sigma
    rows = np.column_stack([time, scans.direction * scans.ranges[:, None], residual])
    return rows[scans.weight > 0]
