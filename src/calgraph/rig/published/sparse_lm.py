"""Sparse Levenberg–Marquardt on manifolds. It operates on blocks of variables and whitened residuals."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numpy.typing import NDArray

from calgraph.errors import CalibrationError
from calgraph.geometry import Array
from calgraph.solver.levenberg_marquardt import Minimum, minimize

Values = Mapping[str, Array]
"""Arrays of variables by block name; the first axis counts the variables of a block."""


@dataclass(frozen=True)
class Block:
    """One kind of variable."""

    dim: int
    """Size of its tangent space."""
    retract: Callable[[Array, Array], Array]
    """Values (M, ...) and tangent vectors (M, dim) to values."""
    fixed: tuple[int, ...] = ()
    """Indices of variables that are not estimated."""


@dataclass(frozen=True, eq=False)
class Term:
    """Derivatives of M residuals by one variable each."""

    block: str
    index: NDArray[np.intp]
    """(M,) which variable of the block."""
    jacobian: Array
    """(M, k, dim)."""


class Factor(Protocol):
    """M residuals of one kind, each of k numbers."""

    @property
    def name(self) -> str:
        """Kind of the residuals, for reports."""

    def linearize(self, values: Values) -> tuple[Array, Sequence[Term]]:
        """Whitened residuals (M, k) and their derivatives."""


@dataclass(frozen=True, eq=False)
class SparseEquations:
    """Normal equations of all factors at a state."""

    cost: float
    """Half the sum of squared whitened residuals."""
    H: scipy.sparse.csc_matrix
    g: Array

    def solve(self, damping: float) -> tuple[Array, float]:
        """The damped step, and its predicted decrease of the cost."""
        diagonal = self.H.diagonal()
        # Marquardt's scaling, with a floor that damps unobservable directions, too.
        scaling = damping * np.maximum(diagonal, 1e-6 * diagonal.max())
        step = -scipy.sparse.linalg.splu((self.H + scipy.sparse.diags(scaling)).tocsc()).solve(self.g)
        return step, 0.5 * float(step @ (scaling * step - self.g))


def minimize_sparse(
    values: Values, blocks: Mapping[str, Block], factors: Sequence[Factor], *, iterations: int
) -> Minimum[Values, SparseEquations]:
    """Minimises half the sum of squared residuals of all factors.

    Args:
        values: start values of every block.
        blocks: what kind of variable each block is.
        factors: the residuals.
        iterations: steps at most, rejected ones included.

    Raises:
        CalibrationError: the residuals are not finite at the start.
    """
    offsets, size = _variable_offsets(values, blocks)
    minimum = minimize(
        values,
        lambda values, _: _normal_equations(values, offsets, size, factors),
        lambda values, step: _apply_step(values, blocks, offsets, step),
        iterations=iterations,
        tolerance=1e-14,
    )
    if not np.isfinite(minimum.linearization.cost):
        raise CalibrationError("the start values give residuals that are not finite")
    return minimum


def marginal_covariance(
    values: Values, blocks: Mapping[str, Block], factors: Sequence[Factor], block: str, prior: Array
) -> Array:
    """Covariance of all free variables of one block, the others marginalised out.

    Args:
        values: the solution.
        blocks: what kind of variable each block is.
        factors: the residuals.
        block: the block whose covariance is asked for.
        prior: (dim,) prior standard deviations of a variable of the block: the result along unobservable
            directions.

    Returns:
        (M·dim, M·dim) in the order of the block's variables; zero for fixed ones.
    """
    offsets, size = _variable_offsets(values, blocks)
    H = _normal_equations(values, offsets, size, factors).H
    dim = blocks[block].dim
    free = offsets[block][offsets[block] >= 0]
    columns = (free[:, None] + np.arange(dim)).ravel()
    prior_information = np.zeros(size)
    prior_information[columns] = np.tile(1 / prior**2, len(free))
    # Variables without any residual would make the system singular.
    prior_information += 1e-12 * H.diagonal().max()
    selector = scipy.sparse.csc_matrix(
        (np.ones(len(columns)), (columns, np.arange(len(columns)))), shape=(size, len(columns))
    )
    found = scipy.sparse.linalg.splu((H + scipy.sparse.diags(prior_information)).tocsc()).solve(
        selector.toarray()
    )[columns]
    position = (np.flatnonzero(offsets[block] >= 0)[:, None] * dim + np.arange(dim)).ravel()
    covariance = np.zeros((len(offsets[block]) * dim,) * 2)
    covariance[np.ix_(position, position)] = (found + found.T) / 2
    return covariance


def _variable_offsets(values: Values, blocks: Mapping[str, Block]) -> tuple[dict[str, NDArray[np.intp]], int]:
    """Position of every variable in the stacked tangent vector, -1 for fixed ones; and that vector's length."""
    offsets: dict[str, NDArray[np.intp]] = {}
    size = 0
    for name, block in blocks.items():
        free = np.ones(len(values[name]), dtype=bool)
        free[list(block.fixed)] = False
        position = np.full(len(free), -1, dtype=np.intp)
        position[free] = size + block.dim * np.arange(free.sum())
        offsets[name] = position
        size += block.dim * int(free.sum())
    return offsets, size


def _normal_equations(
    values: Values, offsets: Mapping[str, NDArray[np.intp]], size: int, factors: Sequence[Factor]
) -> SparseEquations:
    """Cost, JᵀJ and Jᵀr."""
    cost, gradient = 0.0, np.zeros(size)
    rows, columns, entries = [], [], []
    for factor in factors:
        r, terms = factor.linearize(values)
        cost += 0.5 * float(np.sum(r**2))
        for first in terms:
            at_first = offsets[first.block][first.index]
            free = at_first >= 0
            index = at_first[free, None] + np.arange(first.jacobian.shape[2])
            np.add.at(gradient, index, np.einsum("mki,mk->mi", first.jacobian[free], r[free]))
            for second in terms:
                both = free & (offsets[second.block][second.index] >= 0)
                i = at_first[both, None] + np.arange(first.jacobian.shape[2])
                j = offsets[second.block][second.index][both, None] + np.arange(second.jacobian.shape[2])
                products = np.einsum("mki,mkj->mij", first.jacobian[both], second.jacobian[both])
                rows.append(np.broadcast_to(i[:, :, None], products.shape).ravel())
                columns.append(np.broadcast_to(j[:, None, :], products.shape).ravel())
                entries.append(products.ravel())
    triplets = (np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns)))
    H = scipy.sparse.coo_matrix(triplets, shape=(size, size)).tocsc()
    return SparseEquations(cost, H, gradient)


def _apply_step(
    values: Values, blocks: Mapping[str, Block], offsets: Mapping[str, NDArray[np.intp]], step: Array
) -> dict[str, Array]:
    """The values after a step; fixed variables stay."""
    moved = {}
    for name, block in blocks.items():
        free = offsets[name] >= 0
        delta = np.zeros((len(free), block.dim))
        delta[free] = step[offsets[name][free, None] + np.arange(block.dim)]
        moved[name] = block.retract(values[name], delta)
    return moved
