"""Sparse matrices over the unknowns of scanners, against dense ones."""

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.network.joint.scanner_matrix import ScannerMatrix, ScannerOrder

COUNT, UNKNOWNS = 24, 4
SIZE = COUNT * UNKNOWNS


def build_corridors(rng: np.random.Generator) -> tuple[ScannerMatrix, Array]:
    """The matrix of scanners in two corridors that cross, in random order, each linked to the next two; and the
    same, dense."""
    scanners = rng.permutation(COUNT)
    corridors = scanners[: COUNT // 2], np.append(scanners[COUNT // 2 :], scanners[COUNT // 4])
    links = np.array([(c[i], c[i + d]) for c in corridors for d in (1, 2) for i in range(len(c) - d)])
    matrix = ScannerMatrix.zeros(ScannerOrder.from_links(COUNT, links, UNKNOWNS))
    dense = np.zeros((SIZE, SIZE))
    for pair in links:
        columns = (UNKNOWNS * pair[:, None] + np.arange(UNKNOWNS)).ravel()
        J = rng.normal(0, 1, (3 * UNKNOWNS, 2 * UNKNOWNS))
        matrix.add(pair, J.T @ J)
        dense[np.ix_(columns, columns)] += J.T @ J
    common = 0.1 * rng.normal(0, 1, (SIZE, 2))
    return ScannerMatrix(matrix.order, matrix.entries, common), dense - common @ common.T


def test_fronts_of_corridors_have_few_scanners(rng: np.random.Generator) -> None:
    matrix, _ = build_corridors(rng)
    assert max(len(front.scanners) for front in matrix.order.fronts) <= 5


def test_every_scanner_is_eliminated_once_and_before_those_that_it_is_linked_with(
    rng: np.random.Generator,
) -> None:
    order = build_corridors(rng)[0].order
    eliminated = np.concatenate([front.scanners[: front.eliminated] for front in order.fronts])
    np.testing.assert_array_equal(order.position[eliminated], np.arange(COUNT))
    for front in order.fronts:
        assert (np.diff(order.position[front.scanners]) > 0).all()


def test_linked_scanners_are_one_front() -> None:
    (front,) = ScannerOrder.complete(5, UNKNOWNS).fronts
    assert front.eliminated == 5


def test_entries_are_those_of_the_dense_matrix(rng: np.random.Generator) -> None:
    matrix, dense = build_corridors(rng)
    np.testing.assert_allclose(matrix.select(np.arange(SIZE)), dense, atol=1e-12)
    np.testing.assert_allclose(matrix.diagonal, np.diag(dense), atol=1e-12)


def test_what_is_fixed_has_an_identity(rng: np.random.Generator) -> None:
    matrix, dense = build_corridors(rng)
    fixed = rng.random(SIZE) < 0.2
    dense[fixed] = dense[:, fixed] = 0.0
    dense[fixed, fixed] = 1.0
    np.testing.assert_allclose(matrix.fix(fixed).select(np.arange(SIZE)), dense, atol=1e-12)


def test_the_product_equals_the_dense_one(rng: np.random.Generator) -> None:
    matrix, dense = build_corridors(rng)
    values = rng.normal(size=(SIZE, 3))
    np.testing.assert_allclose(matrix.multiply(values), dense @ values, atol=1e-10)


def test_the_solution_equals_the_dense_one(rng: np.random.Generator) -> None:
    matrix, dense = build_corridors(rng)
    right = rng.normal(0, 1, (SIZE, 2))
    np.testing.assert_allclose(matrix.factor().solve(right), np.linalg.solve(dense, right), rtol=1e-6, atol=1e-9)


def test_entries_of_the_inverse_between_linked_scanners_equal_the_dense_ones(rng: np.random.Generator) -> None:
    matrix, dense = build_corridors(rng)
    inverse, expected = matrix.factor().invert().select(np.arange(SIZE)), np.linalg.inv(dense)
    known = ~np.isnan(inverse)
    np.testing.assert_allclose(inverse[known], expected[known], rtol=1e-6, atol=1e-9 * expected.max())
    linked = np.eye(COUNT, dtype=np.bool_)
    linked[*matrix.order.ends.T] = True
    assert known[np.kron(linked | linked.T, np.ones((UNKNOWNS, UNKNOWNS), dtype=np.bool_))].all()


def test_pairs_of_the_inverse_equal_the_dense_ones_in_either_order(rng: np.random.Generator) -> None:
    matrix, dense = build_corridors(rng)
    linked = matrix.order.ends
    pairs = np.concatenate([linked, linked[:, ::-1]])
    expected = np.linalg.inv(dense).reshape(COUNT, UNKNOWNS, COUNT, UNKNOWNS)[pairs[:, 0], :, pairs[:, 1]]
    found = matrix.factor().invert().select_pairs(pairs)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())


def test_pairs_that_no_front_contains_are_unknown(rng: np.random.Generator) -> None:
    matrix, _ = build_corridors(rng)
    inverse, pairs = matrix.factor().invert(), np.column_stack(np.triu_indices(COUNT))
    dense = inverse.select(np.arange(SIZE)).reshape(COUNT, UNKNOWNS, COUNT, UNKNOWNS)
    unknown = np.isnan(inverse.select_pairs(pairs)).all(axis=(1, 2))
    assert unknown.any()
    np.testing.assert_array_equal(unknown, np.isnan(dense[pairs[:, 0], 0, pairs[:, 1], 0]))


def test_blocks_of_the_inverse_equal_the_dense_ones(rng: np.random.Generator) -> None:
    matrix, dense = build_corridors(rng)
    columns = rng.permutation(SIZE)[:20]
    expected = np.linalg.inv(dense)[np.ix_(columns, columns)]
    np.testing.assert_allclose(
        matrix.factor().invert_block(columns), expected, rtol=1e-6, atol=1e-9 * expected.max()
    )


def test_a_matrix_that_is_not_positive_definite_is_an_error(rng: np.random.Generator) -> None:
    matrix, _ = build_corridors(rng)
    with pytest.raises(np.linalg.LinAlgError):
        matrix.add_diagonal(np.full(SIZE, -100.0)).factor()
