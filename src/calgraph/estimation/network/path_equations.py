"""Sums over the scans of a body on a spline, and the prior of its path."""

import numpy as np
from scipy.sparse import csr_array

from calgraph.estimation.network.problem import (
    BodyObservations,
    BodyPath,
    BodyScans,
    NetworkProblem,
    NetworkState,
)
from calgraph.estimation.network.scanner_unknowns import (
    FIRST_SYSTEMATIC,
    RANGE_SCALE,
    SCANNER_UNKNOWNS,
    compute_root_times,
)
from calgraph.estimation.network.splines import evaluate_spline
from calgraph.geometry import Array, Index

# Second difference of control points.
_SECOND_DIFFERENCE = np.array([1.0, -2.0, 1.0])

EARLIER, LATER = np.triu_indices(4)
"""Pairs of the four control points that a scan depends on."""


def sum_between_knots(first: Index, weights: Array, values: Array, count: int) -> Array:
    """(W, K - 3, n) sums of values (V, n) times weights (V, W), over the scans between two knots each."""
    scans, kinds = weights.shape
    ends = np.searchsorted(first, np.arange(1, count - 2)) + scans * np.arange(kinds)[:, None]
    sums = csr_array(
        (weights.T.ravel(), np.tile(np.arange(scans), kinds), np.concatenate([[0], ends.ravel()])),
        shape=(kinds * (count - 3), scans),
    )
    return np.asarray((sums @ values).reshape(kinds, count - 3, -1))


def evaluate_at(
    network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath, scans: BodyScans
) -> tuple[Index, Array, Array, Array]:
    """A body at V scans: first control points and weights of :meth:`Knots.basis_at`, pose and rate (V, 3)."""
    first, weights, slopes = body.knots.basis_at(compute_root_times(network, state, scans))
    return (
        first,
        weights,
        evaluate_spline(path.control, first, weights),
        evaluate_spline(path.control, first, slopes),
    )


def compute_stretch(state: NetworkState, body: BodyObservations) -> float:
    """Measured over true lengths of a body's path.

    Paths are smooth in measured lengths: with many control points, they would otherwise be smoother, and more
    likely, the more all ranges are taken for too long.
    """
    return 1 + float(np.mean([state.systematic[scans.scanner, RANGE_SCALE] for scans in body.scans]))


def add_stretch(
    equations: tuple[Array, Array, Array], control: Array, gradient: Array, stretch: float, scanners: int
) -> None:
    """Adds the derivatives of a path's smoothness by the range scales of its scanners.

    Args:
        equations: border (K, 3, n), corner (n, n) and its gradient (n,) of a body, changed in place; the unknowns
            of the scanners are the last.
        control: (K, 2) positions of control points, m.
        gradient: (K, 2) of the smoothness by them.
        stretch: of the path.
        scanners: number of scanners, L.
    """
    border, corner, corner_gradient = equations
    first = len(corner) - SCANNER_UNKNOWNS * scanners + FIRST_SYSTEMATIC + RANGE_SCALE
    columns = first + SCANNER_UNKNOWNS * np.arange(scanners)
    share, slope = 1 / (stretch * scanners), float(np.sum(control * gradient))
    border[:, :2, columns] += share * gradient[:, :, None]
    corner[np.ix_(columns, columns)] += share**2 * slope
    corner_gradient[columns] += share * slope


def compute_smoothness_information(step: float, acceleration_density: float) -> Array:
    """(3, 3) information of three consecutive control points, ``step`` (s) apart: acceleration is white noise."""
    return np.outer(_SECOND_DIFFERENCE, _SECOND_DIFFERENCE) / (step**3 * acceleration_density)


def index_scans(scans: BodyScans) -> Index:
    """(N,) index of the scan of each beam."""
    return np.repeat(np.arange(len(scans.first_beam)), np.diff(scans.first_beam, append=len(scans.ranges)))
