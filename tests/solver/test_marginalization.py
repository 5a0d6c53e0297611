"""Marginalised biases against dense Schur complements."""

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.solver.marginalization import (
    compute_bias_covariance,
    marginalize_bias,
    marginalize_independent_biases,
)


def equations(rng: np.random.Generator, q: int) -> tuple[Array, Array, Array]:
    J, r = rng.normal(size=(4, 9, q)), rng.normal(size=(4, 9))
    return np.swapaxes(J, -1, -2) @ J, np.einsum("vmq,vm->vq", J, r), 0.5 * np.sum(r**2, axis=1)


@pytest.mark.parametrize(("q", "n"), [(3, 3), (5, 3), (6, 6), (4, 2)])
def test_marginalised_equations_are_the_schur_complement(q: int, n: int, rng: np.random.Generator) -> None:
    A, b, cost = equations(rng, q)
    root = rng.normal(size=(n, n))
    Q = root @ root.T
    found_A, found_b, found_cost = marginalize_bias(A, b, cost, Q)
    for v in range(len(A)):
        # The bias shifts the first parameters, and has the prior Q.
        inner = A[v, :n, :n] + np.linalg.inv(Q)
        cross = A[v, :, :n]
        np.testing.assert_allclose(found_A[v], A[v] - cross @ np.linalg.solve(inner, cross.T), atol=1e-9)
        np.testing.assert_allclose(found_b[v], b[v] - cross @ np.linalg.solve(inner, b[v, :n]), atol=1e-9)
        bias = -np.linalg.solve(inner, b[v, :n])
        least = cost[v] + b[v, :n] @ bias + 0.5 * bias @ inner @ bias
        assert found_cost[v] == pytest.approx(least)


def test_independent_biases_are_marginalised_one_after_the_other(rng: np.random.Generator) -> None:
    given, variances = equations(rng, 5), np.array([0.3, 0.0, 2.0])
    expected = marginalize_bias(*given, np.diag(variances))
    for found, of_all in zip(marginalize_independent_biases(*given, variances), expected, strict=True):
        np.testing.assert_allclose(found, of_all, rtol=1e-9, atol=1e-9)


def test_a_direction_without_bias_keeps_its_information(rng: np.random.Generator) -> None:
    A, b, cost = equations(rng, 3)
    found, _, _ = marginalize_bias(A, b, cost, np.diag([0.0, 0.0, 1e9]))
    # A bias without bounds is a parameter of its own.
    expected = A[:, :2, :2] - A[:, :2, 2:] @ A[:, 2:, :2] / A[:, 2:, 2:]
    np.testing.assert_allclose(found[:, :2, :2], expected, rtol=1e-6)
    np.testing.assert_allclose(found[:, 2], 0, atol=1e-6)


def test_without_prior_variance_nothing_changes(rng: np.random.Generator) -> None:
    A, b, cost = equations(rng, 3)
    for found, given in zip(marginalize_bias(A, b, cost, np.zeros((3, 3))), (A, b, cost), strict=True):
        np.testing.assert_allclose(found, given)


@pytest.mark.parametrize("n", [2, 3])
def test_the_covariance_of_a_bias_is_that_of_the_summed_information(n: int, rng: np.random.Generator) -> None:
    A, _, _ = equations(rng, n)
    Q = np.diag(np.linspace(0.1, 2, n))
    np.testing.assert_allclose(compute_bias_covariance(A, Q), np.linalg.inv(A + np.linalg.inv(Q)), atol=1e-12)


@pytest.mark.parametrize("n", [2, 3, 6])
@pytest.mark.parametrize("largest", [1e6, 1e12, 1e18])
def test_covariances_are_definite_where_directions_differ_by_many_digits(
    n: int, largest: float, rng: np.random.Generator
) -> None:
    """Along the axes of the information, the variances are those of single numbers as far as it has digits."""
    axes, _ = np.linalg.qr(rng.normal(size=(4, n, n)))
    information = np.geomspace(1e-3, largest, n)
    A = (axes * information) @ np.swapaxes(axes, -1, -2)
    found = compute_bias_covariance(A, 0.5 * np.eye(n))
    values = np.linalg.eigvalsh(found)
    assert values.min() >= -1e-15
    assert values.max() <= 0.5 * (1 + 1e-9)
    if largest == 1e6:
        np.testing.assert_allclose(
            np.sort(values), np.tile(np.sort(0.5 / (1 + 0.5 * information)), (4, 1)), rtol=1e-6
        )
