"""Sums over the scans of a body on a spline, and the prior of its path."""

from collections.abc import Iterable

import numpy as np
from scipy.sparse import csr_array

from calgraph.geometry import Array, Index
from calgraph.network.joint.problem import BodyObservations, BodyPath, BodyScans, NetworkProblem, NetworkState
from calgraph.network.joint.scan_equations import ScanTerms
from calgraph.network.joint.scanner_unknowns import (
    FIRST_SYSTEMATIC,
    RANGE_SCALE,
    SCANNER_UNKNOWNS,
    compute_root_times,
)
from calgraph.network.joint.schur import BodyEquations
from calgraph.network.joint.splines import evaluate_spline

# Second difference of control points.
_SECOND_DIFFERENCE = np.array([1.0, -2.0, 1.0])

# Pairs of the four control points that a scan depends on.
_EARLIER, _LATER = np.triu_indices(4)


def add_scans(equations: BodyEquations, terms: Iterable[ScanTerms], first_control: int = 0) -> float:
    """Adds the terms of scans of each scanner to the equations of a body, in place; returns their cost.

    Args:
        equations: of the body, or of a part of its path.
        terms: one for each scanner at most.
        first_control: the control point at which the part begins.
    """
    band, gradient, border = equations.band, equations.gradient, equations.border
    corner, corner_gradient, shapes, cost = equations.corner, equations.corner_gradient, equations.shape_count, 0.0
    intervals = len(band) - 3
    pairs, points = np.zeros((len(_EARLIER), intervals, 9)), np.zeros((4, intervals, 3))
    for one in terms:
        A, b, G = one.equations.information, one.equations.gradient, one.scanner_jacobian
        cost += float(one.equations.cost.sum())
        AG, rows, own = A @ G, one.shape_rows, one.shape_columns
        first_column = shapes + SCANNER_UNKNOWNS * one.place
        of_scanner = slice(first_column, first_column + SCANNER_UNKNOWNS)
        flat = G.reshape(-1, SCANNER_UNKNOWNS)
        corner[of_scanner, of_scanner] += flat.T @ AG.reshape(-1, SCANNER_UNKNOWNS)
        corner[np.ix_(own, own)] += A[:, rows, rows].sum(axis=0)
        mixed = AG[:, rows].sum(axis=0)
        corner[own, of_scanner] += mixed
        corner[of_scanner, own] += mixed.T
        corner_gradient[of_scanner] += flat.T @ b.ravel()
        corner_gradient[own] += b[:, rows].sum(axis=0)
        # A scan depends on the four control points about it: terms of each of them, and of each pair. A scanner
        # measures a body on a part of its path only.
        first = one.first - first_control
        begin, end = first[0], first[-1] + 1
        by_shape, by_scanner = A[:, :3, rows].reshape(len(b), -1), AG[:, :3].reshape(len(b), -1)
        values = np.concatenate([b[:, :3], by_shape, by_scanner], axis=1)
        sums = _sum_between_knots(first - begin, one.weights, values, end - begin)
        points[:, begin:end] += sums[..., :3]
        for i, of_point in enumerate(sums):
            near = slice(begin + i, end + i)
            border[near, :, own] += of_point[:, 3 : 3 + by_shape.shape[1]].reshape(end - begin, 3, -1)
            border[near, :, of_scanner] += of_point[:, 3 + by_shape.shape[1] :].reshape(end - begin, 3, -1)
        products = one.weights[:, _EARLIER] * one.weights[:, _LATER]
        blocks = A[:, :3, :3].reshape(-1, 9)
        pairs[:, begin:end] += _sum_between_knots(first - begin, products, blocks, end - begin)
    for i, of_point in enumerate(points):
        gradient[i : intervals + i] += of_point
    for earlier, later, of_pair in zip(_EARLIER, _LATER, pairs, strict=True):
        band[earlier : intervals + earlier, later - earlier] += of_pair.reshape(-1, 3, 3)
    return cost


def _sum_between_knots(first: Index, weights: Array, values: Array, intervals: int) -> Array:
    """(W, intervals, n) sums of values (V, n) times weights (V, W), over the scans between two knots each."""
    scans, kinds = weights.shape
    ends = np.searchsorted(first, np.arange(1, intervals + 1)) + scans * np.arange(kinds)[:, None]
    sums = csr_array(
        (weights.T.ravel(), np.tile(np.arange(scans), kinds), np.concatenate([[0], ends.ravel()])),
        shape=(kinds * intervals, scans),
    )
    return np.asarray((sums @ values).reshape(kinds, intervals, -1))


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


def add_stretch(equations: BodyEquations, control: Array, gradient: Array, stretch: float, scanners: int) -> None:
    """Adds the derivatives of a path's smoothness by the range scales of its scanners.

    Args:
        equations: of the body, changed in place.
        control: (K, 2) positions of control points, m.
        gradient: (K, 2) of the smoothness by them.
        stretch: of the path.
        scanners: number of scanners, L.
    """
    first = equations.shape_count + FIRST_SYSTEMATIC + RANGE_SCALE
    columns = first + SCANNER_UNKNOWNS * np.arange(scanners)
    share, slope = 1 / (stretch * scanners), float(np.sum(control * gradient))
    equations.border[:, :2, columns] += share * gradient[:, :, None]
    equations.corner[np.ix_(columns, columns)] += share**2 * slope
    equations.corner_gradient[columns] += share * slope


def compute_smoothness_information(step: float, acceleration_density: float) -> Array:
    """(3, 3) information of three consecutive control points, ``step`` (s) apart: acceleration is white noise."""
    return np.outer(_SECOND_DIFFERENCE, _SECOND_DIFFERENCE) / (step**3 * acceleration_density)


def index_scans(scans: BodyScans) -> Index:
    """(N,) index of the scan of each beam."""
    return np.repeat(np.arange(len(scans.first_beam)), np.diff(scans.first_beam, append=len(scans.ranges)))
