"""Banded matrices over the unknowns of scanners, against dense ones."""

import numpy as np
import pytest

from calgraph.estimation.network.scanner_matrix import ScannerMatrix, ScannerOrder
from calgraph.geometry import Array

COUNT, UNKNOWNS = 24, 4
SIZE = COUNT * UNKNOWNS


def build_chain(rng: np.random.Generator) -> tuple[ScannerMatrix, Array]:
    """The matrix of scanners in a corridor, in random order, each linked to the next two; and the same, dense."""
    scanners = rng.permutation(COUNT)
    links = np.array([(scanners[i], scanners[i + d]) for i in range(COUNT) for d in (1, 2) if i + d < COUNT])
    matrix = ScannerMatrix.zeros(ScannerOrder.from_links(COUNT, links, UNKNOWNS))
    dense = np.zeros((SIZE, SIZE))
    for pair in links:
        columns = (UNKNOWNS * pair[:, None] + np.arange(UNKNOWNS)).ravel()
        J = rng.normal(0, 1, (3 * UNKNOWNS, 2 * UNKNOWNS))
        matrix.add(columns, J.T @ J)
        dense[np.ix_(columns, columns)] += J.T @ J
    common = 0.1 * rng.normal(0, 1, (SIZE, 2))
    return ScannerMatrix(matrix.order, matrix.band, common), dense - common @ common.T


def test_scanners_with_common_entries_are_near_each_other(rng: np.random.Generator) -> None:
    matrix, _ = build_chain(rng)
    assert matrix.order.reach <= 3
    assert len(matrix.band) == UNKNOWNS * (matrix.order.reach + 1)


def test_entries_are_those_of_the_dense_matrix(rng: np.random.Generator) -> None:
    matrix, dense = build_chain(rng)
    np.testing.assert_allclose(matrix.select(np.arange(SIZE)), dense, atol=1e-12)
    np.testing.assert_allclose(matrix.diagonal, np.diag(dense), atol=1e-12)


def test_what_is_fixed_has_an_identity(rng: np.random.Generator) -> None:
    matrix, dense = build_chain(rng)
    fixed = rng.random(SIZE) < 0.2
    dense[fixed] = dense[:, fixed] = 0.0
    dense[fixed, fixed] = 1.0
    np.testing.assert_allclose(matrix.fix(fixed).select(np.arange(SIZE)), dense, atol=1e-12)


def test_the_solution_equals_the_dense_one(rng: np.random.Generator) -> None:
    matrix, dense = build_chain(rng)
    right = rng.normal(0, 1, (SIZE, 2))
    np.testing.assert_allclose(matrix.factor().solve(right), np.linalg.solve(dense, right), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("near", [1, 5, COUNT])
def test_near_entries_of_the_inverse_equal_the_dense_ones(near: int, rng: np.random.Generator) -> None:
    matrix, dense = build_chain(rng)
    inverse, expected = matrix.factor().invert(near).select(np.arange(SIZE)), np.linalg.inv(dense)
    known = ~np.isnan(inverse)
    np.testing.assert_allclose(inverse[known], expected[known], rtol=1e-6, atol=1e-9 * expected.max())
    position = matrix.order.position
    reached = np.abs(position[:, None] - position) <= max(matrix.order.reach, near if near == COUNT else 0)
    assert known[np.kron(reached, np.ones((UNKNOWNS, UNKNOWNS), dtype=np.bool_))].all()


def test_a_matrix_that_is_not_positive_definite_is_an_error(rng: np.random.Generator) -> None:
    matrix, _ = build_chain(rng)
    with pytest.raises(np.linalg.LinAlgError):
        matrix.add_diagonal(np.full(SIZE, -100.0)).factor()
