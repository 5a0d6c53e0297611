"""Parts of a network's normal equations, by body and interval of time: what each contributes to the scanners.

Paths and shapes of bodies follow the scanners as in the whole solution, by its back substitution: the sum over all
scans and the priors of paths is the Schur complement.
"""

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index
from calgraph.network.joint.body_equations import linearize_scans
from calgraph.network.joint.path_equations import add_scans
from calgraph.network.joint.problem import BodyObservations, BodyPath, NetworkProblem, NetworkState
from calgraph.network.joint.scan_equations import TUKEY_LIMIT, TukeyLoss
from calgraph.network.joint.scanner_matrix import NearInverse, ScannerMatrix
from calgraph.network.joint.scanner_unknowns import CLOCK, SCANNER_UNKNOWNS, compute_root_times, list_columns
from calgraph.network.joint.schur import BodyEquations, compute_back_substitution, eliminate_path
from calgraph.network.joint.solver import NetworkEquations


@dataclass(frozen=True, eq=False)
class Contributions:
    """C parts of normal equations over the n estimated unknowns of a group of scanners."""

    body: Index
    """(C,) whose scans a part has."""
    time: Array
    """(C,) s, of the middle of its interval by the root's clock."""
    columns: tuple[Index, ...]
    """(m,) of each part among the n, those of the scanners that measured its body."""
    information: tuple[Array, ...]
    """(m, m) of each part."""
    gradient: tuple[Array, ...]
    """(m,) of each part, scaled such that its covariance is the information."""
    prior: Array
    """(n, n) weight of walls and priors, which all parts share, beside that of the parts."""
    prior_covariance: Array
    """(n, n) of their gradient."""
    unknowns: Index
    """(n,) columns in the equations of all scanners."""

    @property
    def scanner(self) -> Index:
        """(n,) of each unknown."""
        return self.unknowns // SCANNER_UNKNOWNS

    @property
    def is_placement(self) -> NDArray[np.bool_]:
        """(n,) whether an unknown is of a pose or a clock offset."""
        return np.asarray(self.unknowns % SCANNER_UNKNOWNS <= CLOCK)

    @property
    def amount(self) -> Array:
        """(C,) information of each part, as one number: the trace."""
        return np.array([np.trace(of_part) for of_part in self.information])

    @property
    def covariance(self) -> Array:
        """(n, n) inverse of the matrix of all parts and priors."""
        return np.asarray(np.linalg.inv(self.prior + self.sum_information(np.ones(len(self.body)))))

    def sum_information(self, weight: Array) -> Array:
        """(n, n) sum of the information of all parts by weights (C,)."""
        total = np.zeros_like(self.prior)
        # Parts of a body have the same columns: plain sums of these take little time.
        for parts in np.split(np.arange(len(self.body)), 1 + np.flatnonzero(np.diff(self.body))):
            if len(parts):
                columns = self.columns[parts[0]]
                total[np.ix_(columns, columns)] += sum(weight[c] * self.information[c] for c in parts)
        return total

    def sum_gradient(self, weight: Array) -> Array:
        """(n,) sum of the gradients of all parts by weights (C,)."""
        total = np.zeros(len(self.unknowns))
        for factor, columns, of_part in zip(weight, self.columns, self.gradient, strict=True):
            total[columns] += factor * of_part
        return total

    def test_difference(self, first: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
        """Score and information of a difference between two halves of the parts.

        Args:
            first: (C,) whether a part is in the first half.

        Returns:
            The gradient (n,) by the second half's unknowns minus the first's, their mean being that of the
            solution; the covariance (n, n) of the gradient; and what its standard deviations (n,) would be if the
            mean was given. Where only one half has data, there is no covariance but rounding errors of these.
        """
        weight = np.where(first, -0.5, 0.5)
        total, difference = self.sum_information(np.ones(len(weight))), self.sum_information(weight)
        by_total = difference @ self.covariance
        covariance = 0.25 * total + by_total @ (total + self.prior_covariance) @ by_total.T
        crossed = by_total @ difference
        scale = 0.5 * np.sqrt(np.diag(total))
        return self.sum_gradient(weight), covariance - crossed - crossed.T, scale


@dataclass(frozen=True, eq=False)
class NetworkContributions:
    """C parts of the normal equations of all scanners, each over the unknowns of those that measured its body."""

    body: Index
    """(C,) whose scans a part has."""
    time: Array
    """(C,) s, of the middle of its interval by the root's clock."""
    columns: tuple[Index, ...]
    """(m,) of each part, in the equations of all scanners; only estimated ones."""
    triangle: tuple[Array, ...]
    """(m (m + 1) / 2,) lower triangle of the information of each part, row by row."""
    gradient: tuple[Array, ...]
    """(m,) of each part, scaled such that its covariance is the information."""
    prior: ScannerMatrix
    """Weight of walls and priors, which all parts share, beside that of the parts; 1 for what is fixed."""
    prior_scale: float
    """The covariance of their gradient over their weight."""
    estimated: NDArray[np.bool_]
    """(US,)."""

    @cached_property
    def inverse(self) -> NearInverse:
        """Of the matrix of all parts and priors."""
        total = self.prior.copy()
        for c, columns in enumerate(self.columns):
            scanners = np.unique(columns // SCANNER_UNKNOWNS)
            at = np.searchsorted(list_columns(scanners.tolist()), columns)
            block = np.zeros((SCANNER_UNKNOWNS * len(scanners),) * 2)
            block[np.ix_(at, at)] = self.expand_information(c)
            total.add(scanners, block)
        return total.factor().invert()

    def expand_information(self, part: int) -> Array:
        """(m, m) information of a part."""
        size = len(self.columns[part])
        information, lower = np.empty((size, size)), np.tril_indices(size)
        information[lower] = information[lower[::-1]] = self.triangle[part]
        return information

    def group_scanners(self, max_scanners: int) -> list[Index]:
        """Scanners near each other, of which any measured a body that several scanners did.

        Args:
            max_scanners: in a group; a network of as many is one group.
        """
        position, measured = self.prior.order.position, np.zeros(len(self.prior.order.position), dtype=np.bool_)
        for columns in self.columns:
            measured[columns // SCANNER_UNKNOWNS] = True
        groups = np.array_split(np.argsort(position), -(-len(position) // max_scanners))
        return [np.sort(group) for group in groups if measured[group].any()]

    def select(self, scanners: Index) -> Contributions:
        """The parts over the unknowns of some scanners, given the others."""
        columns = list_columns(scanners.tolist())
        unknowns = columns[self.estimated[columns]]
        row = np.full(len(self.estimated), -1)
        row[unknowns] = np.arange(len(unknowns))
        inside = [row[of_part] >= 0 for of_part in self.columns]
        chosen = [c for c, kept in enumerate(inside) if kept.any()]
        prior = self.prior.select(unknowns)
        return Contributions(
            self.body[chosen],
            self.time[chosen],
            tuple(row[self.columns[c][inside[c]]] for c in chosen),
            tuple(_select_block(self.expand_information(c), inside[c]) for c in chosen),
            tuple(self.gradient[c][inside[c]] for c in chosen),
            prior,
            self.prior_scale * prior,
            unknowns,
        )


def _select_block(matrix: Array, selected: NDArray[np.bool_]) -> Array:
    # Those of a small network take much memory, and all of it is selected.
    return matrix if selected.all() else matrix[np.ix_(selected, selected)]


def split_contributions(equations: NetworkEquations, interval: float) -> NetworkContributions:
    """Splits the normal equations of a solution by body and interval of time, s."""
    # Gradients of a redescending loss have less variance, and change less with the unknowns, than the information
    # in its weights predicts. Scaled to that information, priors weigh more.
    scale = TukeyLoss(TUKEY_LIMIT).score_to_information ** -0.5
    bodies, times, all_columns, triangles, gradient = [], [], [], [], []
    estimated = [equations.estimated[columns] for columns in equations.columns]
    split = equations.map(partial(_split_body, interval=interval), estimated)
    for index, (columns, of_body) in enumerate(zip(equations.columns, split, strict=True)):
        for time, triangle, b in of_body:
            bodies.append(index)
            times.append(time)
            all_columns.append(columns[estimated[index]])
            triangles.append(triangle)
            gradient.append(scale * b)
    prior = equations.H.add_diagonal(equations.regularizer).scale(scale).fix(~equations.estimated)
    return NetworkContributions(
        np.array(bodies, dtype=np.intp),
        np.array(times),
        tuple(all_columns),
        tuple(triangles),
        tuple(gradient),
        prior,
        scale,
        equations.estimated,
    )


def _split_body(
    network: NetworkProblem,
    state: NetworkState,
    body: BodyObservations,
    path: BodyPath,
    equations: BodyEquations,
    estimated: NDArray[np.bool_],
    interval: float,
) -> list[tuple[float, Array, Array]]:
    """Time, information and gradient (m,) of each interval of a body, over its m estimated unknowns.

    The information is the lower triangle of (m, m), row by row: there are many of them.

    A body with biases is one part: they make its intervals depend on each other.
    """
    size = len(equations.corner) - equations.shape_count
    H, g = eliminate_path(equations, 0.0)
    if body.has_biases:
        middle = body.knots.start + body.knots.duration / 2
        return [(middle, _take_triangle(H, estimated), g[estimated])]
    substitution = compute_back_substitution(equations)[:, :-1]
    count = int(body.knots.duration / interval) + 1
    information, gradient = np.zeros((count, size, size)), np.zeros((count, size))
    prior_gradient = equations.gradient.copy()

    def part_of(times: Array) -> Index:
        return np.clip((times - body.knots.start) / interval, 0, count - 1).astype(np.intp)

    all_terms = [linearize_scans(network, state, body, path, k) for k in range(len(body.scans))]
    # Scans of a scanner are in order of time.
    ends = [
        np.searchsorted(part_of(compute_root_times(network, state, scans)), np.arange(count + 1))
        for scans in body.scans
    ]
    for n in range(count):
        measured = [(one, *bounds[n : n + 2]) for one, bounds in zip(all_terms, ends, strict=True)]
        terms = [one.select(slice(start, stop)) for one, start, stop in measured if start < stop]
        if not terms:
            continue
        begin, end = min(one.first[0] for one in terms), max(one.first[-1] for one in terms) + 4
        sums = BodyEquations.zeros(end - begin, equations.shape_count, size)
        add_scans(sums, terms, begin)
        rows = np.r_[3 * begin : 3 * end, 3 * body.knots.count : len(substitution)]
        information[n], gradient[n] = sums.follow(substitution[rows])
        prior_gradient[begin:end] -= sums.gradient
    # What is left of the gradient of the path is that of its prior.
    of_knot = part_of(body.knots.control_times())
    by_path = substitution[: 3 * body.knots.count].reshape(-1, 3, size)
    np.add.at(gradient, of_knot, -np.einsum("kpq,kp->kq", by_path, prior_gradient))
    # Priors of path and shape are of no scan: intervals share their information, and the rest of their gradient.
    share = np.trace(information, axis1=1, axis2=2)
    share /= share.sum()
    information += share[:, None, None] * (H - information.sum(axis=0))
    gradient += share[:, None] * (g - gradient.sum(axis=0))
    return [
        (
            body.knots.start + (n + 0.5) * interval,
            _take_triangle(information[n], estimated),
            gradient[n, estimated],
        )
        for n in np.flatnonzero(share).tolist()
    ]


def _take_triangle(matrix: Array, selected: NDArray[np.bool_]) -> Array:
    """The lower triangle of the selected rows and columns, row by row."""
    places = np.flatnonzero(selected)
    row, column = np.tril_indices(len(places))
    return matrix[places[row], places[column]]
