"""Normal equations of views against dense matrices, and statistics of views against known values."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.geometry import Array, Index
from calgraph.rig.bundle.bundle_solver import HUBER_THRESHOLD
from calgraph.rig.bundle.normal_equations import (
    BiasVariances,
    accumulate,
    consistency_statistic,
    huber_variance_factor,
)
from calgraph.rig.bundle.observations import LinearizedResiduals
from calgraph.rig.bundle.variance_components import MIN_REDUNDANCY

START = np.array([0, 30, 37])
COUNTS = [30, 7, 23]


def random_residuals(rng: np.random.Generator, k: int, q: int, p: int, size: float = 1.0) -> LinearizedResiduals:
    return LinearizedResiduals(
        size * rng.normal(size=(60, k)), rng.normal(size=(60, k, q)), rng.normal(size=(len(COUNTS), q, p)), q
    )


def marginalized(linearized: LinearizedResiduals, start: Index, view_bias: Array) -> tuple[Array, Array, Array]:
    """Along the sensor's axes, with variances (6,) of the bias of a view, none of rings and of the stamp."""
    variances = BiasVariances(view_bias, np.zeros(()), np.zeros(()))
    equations = accumulate(linearized, start, HUBER_THRESHOLD, lambda found: found.estimate_bias(variances))
    information, gradient, costs = equations.marginalize_bias(variances)
    turned = np.swapaxes(linearized.local_jacobian, -1, -2)
    return turned @ information @ linearized.local_jacobian, (turned @ gradient[..., None])[..., 0], costs


def dense(linearized: LinearizedResiduals, view: int) -> tuple[Array, Array]:
    """Jacobian by everything and residual of one view."""
    of = slice(START[view], START[view] + COUNTS[view])
    J = linearized.jacobian[of] @ linearized.local_jacobian[view]
    return J.reshape(-1, J.shape[-1]), linearized.residual[of].ravel()


@pytest.mark.parametrize(("k", "q", "p"), [(2, 6, 6), (1, 3, 6), (1, 4, 7), (2, 12, 12)])
def test_normal_equations_are_those_of_dense_matrices(rng: np.random.Generator, k: int, q: int, p: int) -> None:
    linearized = random_residuals(rng, k, q, p, size=0.3)
    equations = accumulate(linearized, START, HUBER_THRESHOLD)
    for view in range(len(COUNTS)):
        J, r = dense(linearized, view)
        np.testing.assert_allclose(equations.information[view], J.T @ J, atol=1e-9)
        np.testing.assert_allclose(equations.gradient[view], J.T @ r, atol=1e-9)
        assert equations.squared_residuals[view] == pytest.approx(r @ r)
        assert equations.residual_count[view] == k * COUNTS[view]


def test_views_without_measurements_have_no_information(rng: np.random.Generator) -> None:
    linearized = LinearizedResiduals(
        3 * rng.normal(size=(5, 1)), rng.normal(size=(5, 1, 3)), rng.normal(size=(5, 3, 6)), 3
    )
    equations = accumulate(linearized, np.array([0, 0, 3, 3, 5]), HUBER_THRESHOLD)
    assert equations.residual_count.tolist() == [0, 3, 0, 2, 0]
    assert not equations.JtJ[[0, 2, 4]].any()
    full = accumulate(
        replace(linearized, local_jacobian=linearized.local_jacobian[[1, 3]]), np.array([0, 3]), HUBER_THRESHOLD
    )
    np.testing.assert_array_equal(equations.Jtr[[1, 3]], full.Jtr)


def costs_after(linearized: LinearizedResiduals, step: Array, view_bias: Array) -> Array:
    """Costs (V,) of the views after the pose has moved."""
    view = np.repeat(np.arange(len(COUNTS)), COUNTS)
    residual = linearized.residual + linearized.jacobian @ linearized.local_jacobian[view] @ step
    return marginalized(replace(linearized, residual=residual), START, view_bias)[2]


@pytest.mark.parametrize("view_bias", [0.0, 0.01, 1.0])
def test_gradient_is_the_derivative_of_the_cost(rng: np.random.Generator, view_bias: float) -> None:
    linearized, variances = random_residuals(rng, 2, 6, 6, size=1.5), np.full(6, view_bias)
    _, gradient, _ = marginalized(linearized, START, variances)
    for axis, step in enumerate(1e-5 * np.eye(6)):
        slope = (costs_after(linearized, step, variances) - costs_after(linearized, -step, variances)) / 2e-5
        # Robust weights are iterated a few times only.
        np.testing.assert_allclose(slope, gradient[:, axis], atol=0.01 * np.abs(gradient).max())


def test_scatter_is_about_the_best_fit_of_each_view(rng: np.random.Generator) -> None:
    linearized = random_residuals(rng, 1, 3, 6, size=0.3)
    squares, freedom = accumulate(linearized, START, HUBER_THRESHOLD).within_view_scatter()
    for view, count in enumerate(COUNTS):
        J, r = dense(linearized, view)
        left = r - J @ np.linalg.lstsq(J, r, rcond=None)[0]
        assert squares[view] == pytest.approx(left @ left)
        assert freedom[view] == count - 3


def test_unmeasured_directions_take_no_degrees_of_freedom(rng: np.random.Generator) -> None:
    linearized = random_residuals(rng, 1, 3, 6)
    linearized.jacobian[..., 2] = 0
    assert accumulate(linearized, START, HUBER_THRESHOLD).within_view_scatter()[1].tolist() == [28, 5, 21]


def one_view(J: Array, r: Array) -> LinearizedResiduals:
    """A view of scalar measurements that depend on the full pose."""
    return LinearizedResiduals(r[:, None], J[:, None], np.eye(6)[None], 6)


FIRST = np.array([0])


def test_information_with_the_bias_marginalised(rng: np.random.Generator) -> None:
    J, r = rng.normal(size=(20, 6)), 0.3 * rng.normal(size=20)
    A, view_bias = J.T @ J, np.array([0.1, 0.1, 0.1, 0.3, 0.3, 0.3])
    information, gradient, _ = marginalized(one_view(J, r), FIRST, view_bias)
    expected = np.linalg.inv(np.linalg.inv(A) + np.diag(view_bias))
    np.testing.assert_allclose(information[0], expected, atol=1e-10)
    # The optimum does not change: -A⁻¹ b.
    np.testing.assert_allclose(
        np.linalg.solve(information[0], gradient[0]), np.linalg.solve(A, J.T @ r), atol=1e-8
    )


def test_a_marginalised_bias_keeps_unmeasured_directions_unmeasured(rng: np.random.Generator) -> None:
    J, view_bias = rng.normal(size=(20, 3)) @ rng.normal(size=(3, 6)), np.full(6, 0.2)
    information = marginalized(one_view(J, np.zeros(20)), FIRST, view_bias)[0][0]
    # In the limit of hardly any information on the rest.
    limit = np.linalg.inv(np.linalg.inv(J.T @ J + 1e-7 * np.eye(6)) + np.diag(view_bias))
    np.testing.assert_allclose(information, limit, atol=1e-5)


def test_cost_with_the_bias_marginalised_is_the_minimum_over_the_bias(rng: np.random.Generator) -> None:
    J, r, view_bias = rng.normal(size=(20, 6)), 0.3 * rng.normal(size=20), np.linspace(0.1, 0.5, 6)
    cost = marginalized(one_view(J, r), FIRST, view_bias)[2][0]
    best = -np.linalg.solve(J.T @ J + np.diag(1 / view_bias), J.T @ r)
    left = r + J @ best
    assert cost == pytest.approx(0.5 * left @ left + 0.5 * best @ (best / view_bias))


def test_measurements_of_a_biased_view_are_no_outliers(rng: np.random.Generator) -> None:
    J = rng.normal(size=(40, 6))
    far = J @ np.full(6, 10.0) + 0.3 * rng.normal(size=40)
    information = marginalized(one_view(J, far), FIRST, np.full(6, 100.0))[0]
    np.testing.assert_allclose(
        information, marginalized(one_view(J, 0 * far), FIRST, np.full(6, 100.0))[0], rtol=1e-10
    )


def test_outliers_in_a_biased_view_hardly_count(rng: np.random.Generator) -> None:
    J, noise = rng.normal(size=(40, 6)), 0.3 * rng.normal(size=40)
    noise[:3] = 1000
    information, gradient, _ = marginalized(one_view(J, J @ np.full(6, 10.0) + noise), FIRST, np.full(6, 100.0))
    bias = np.linalg.solve(information[0], gradient[0])
    np.testing.assert_allclose(bias, 10.0, atol=1.0)


def test_without_bias_the_equations_do_not_change(rng: np.random.Generator) -> None:
    linearized = random_residuals(rng, 2, 6, 6)
    equations = accumulate(linearized, START, HUBER_THRESHOLD, lambda found: np.zeros_like(found.Jtr))
    information, gradient, costs = marginalized(linearized, START, np.zeros(6))
    np.testing.assert_allclose(information, equations.information, rtol=1e-12)
    np.testing.assert_allclose(gradient, equations.gradient, rtol=1e-12)
    np.testing.assert_allclose(costs, equations.robust_cost_offset + equations.squared_residuals / 2, rtol=1e-12)


def test_consistency_of_three_measurements_of_one_number() -> None:
    """Of 0, 0 and 3 with unit noise the mean is 1: gradients 1, 1 and -2 with variance 2/3 each."""
    squared, freedom = consistency_statistic(
        np.ones((3, 1, 1)), np.full((3, 1, 1), 1 / 3), np.array([[1.0], [1.0], [-2.0]]), MIN_REDUNDANCY
    )
    np.testing.assert_allclose(squared, [1.5, 1.5, 6.0])
    assert freedom.tolist() == [1, 1, 1]


def test_directions_without_redundancy_are_not_tested() -> None:
    """Of two parameters only the first is measured twice."""
    information = np.tile(np.diag([1.0, 1.0]), (1, 1, 1))
    reduction = np.diag([0.5, 1.0])[None]
    squared, freedom = consistency_statistic(information, reduction, np.array([[1.0, 0.0]]), MIN_REDUNDANCY)
    assert squared[0] == pytest.approx(2.0)
    assert freedom[0] == 1


def test_consistency_does_not_depend_on_units(rng: np.random.Generator) -> None:
    root, gradient = rng.normal(size=(9, 6)), rng.normal(size=(1, 6))
    A = (root.T @ root)[None]
    P = 0.3 * np.linalg.inv(A)
    scale = 10.0 ** np.arange(-3, 3)
    D, reduction = np.diag(scale), A @ P @ A
    expected = consistency_statistic(A, reduction, gradient, MIN_REDUNDANCY)[0]
    np.testing.assert_allclose(
        consistency_statistic(D @ A @ D, np.asarray(D @ reduction @ D), gradient @ D, MIN_REDUNDANCY)[0],
        expected,
        rtol=1e-6,
    )


@pytest.mark.parametrize("dimension", [1, 2])
def test_variance_factor_of_huber_weights_under_gaussian_noise(dimension: int) -> None:
    size = np.linalg.norm(np.random.default_rng(0).normal(size=(1_000_000, dimension)), axis=1)
    left = np.minimum(1, HUBER_THRESHOLD / size) * size**2
    standard_error = np.std(left) / dimension / 1000
    assert huber_variance_factor(dimension, HUBER_THRESHOLD) == pytest.approx(
        left.mean() / dimension, abs=4 * standard_error
    )


@pytest.mark.parametrize("k", [1, 2])
def test_the_gradient_of_a_residual_beyond_the_threshold_is_constant(k: int) -> None:
    far, farther = (
        marginalized(
            LinearizedResiduals(np.full((1, k), size), np.ones((1, k, 1)), np.ones((1, 1, 6)), 1),
            np.array([0]),
            np.zeros(6),
        )[1]
        for size in (10.0, 1000.0)
    )
    np.testing.assert_allclose(far, farther)
