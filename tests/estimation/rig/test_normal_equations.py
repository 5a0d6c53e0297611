"""Sums over views against dense ones, and what is made of them against answers computed otherwise."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.estimation.rig.normal_equations import (
    HUBER_THRESHOLD,
    accumulate,
    accumulate_biased,
    consistency_statistic,
    huber_variance_factor,
)
from calgraph.estimation.rig.observations import LinearizedResiduals
from calgraph.geometry import Array, Index

START = np.array([0, 30, 37])
COUNTS = [30, 7, 23]


def random_rows(rng: np.random.Generator, k: int, q: int, p: int, size: float = 1.0) -> LinearizedResiduals:
    return LinearizedResiduals(
        size * rng.normal(size=(60, k)), rng.normal(size=(60, k, q)), rng.normal(size=(len(COUNTS), q, p))
    )


def swayed(rows: LinearizedResiduals, start: Index, sway: Array) -> tuple[Array, Array, Array]:
    """Along the sensor's axes."""
    information, gradient, costs = accumulate_biased(rows, start, sway).marginalize_bias(sway)
    turned = np.swapaxes(rows.local_jacobian, -1, -2)
    return turned @ information @ rows.local_jacobian, (turned @ gradient[..., None])[..., 0], costs


def dense(rows: LinearizedResiduals, view: int) -> tuple[Array, Array]:
    """Jacobian by everything and residual of one view."""
    of = slice(START[view], START[view] + COUNTS[view])
    J = rows.jacobian[of] @ rows.local_jacobian[view]
    return J.reshape(-1, J.shape[-1]), rows.residual[of].ravel()


@pytest.mark.parametrize(("k", "q", "p"), [(2, 6, 6), (1, 3, 6), (1, 4, 7), (2, 12, 12)])
def test_sums_are_those_of_dense_matrices(rng: np.random.Generator, k: int, q: int, p: int) -> None:
    rows = random_rows(rng, k, q, p, size=0.3)
    sums = accumulate(rows, START)
    for view in range(len(COUNTS)):
        J, r = dense(rows, view)
        np.testing.assert_allclose(sums.information[view], J.T @ J, atol=1e-9)
        np.testing.assert_allclose(sums.gradient[view], J.T @ r, atol=1e-9)
        assert sums.squared_residuals[view] == pytest.approx(r @ r)
        assert sums.residual_count[view] == k * COUNTS[view]


def test_views_without_measurements_say_nothing(rng: np.random.Generator) -> None:
    rows = LinearizedResiduals(3 * rng.normal(size=(5, 1)), rng.normal(size=(5, 1, 3)), rng.normal(size=(5, 3, 6)))
    sums = accumulate(rows, np.array([0, 0, 3, 3, 5]))
    assert sums.residual_count.tolist() == [0, 3, 0, 2, 0]
    assert not sums.JtJ[[0, 2, 4]].any()
    full = accumulate(replace(rows, local_jacobian=rows.local_jacobian[[1, 3]]), np.array([0, 3]))
    np.testing.assert_array_equal(sums.Jtr[[1, 3]], full.Jtr)


def costs_after(rows: LinearizedResiduals, step: Array, sway: Array) -> Array:
    """Costs (V,) of the views after the pose has moved."""
    view = np.repeat(np.arange(len(COUNTS)), COUNTS)
    residual = rows.residual + rows.jacobian @ rows.local_jacobian[view] @ step
    return swayed(replace(rows, residual=residual), START, sway)[2]


@pytest.mark.parametrize("sway", [0.0, 0.01, 1.0])
def test_gradient_is_the_slope_of_the_cost(rng: np.random.Generator, sway: float) -> None:
    rows, variances = random_rows(rng, 2, 6, 6, size=1.5), np.full(6, sway)
    _, gradient, _ = swayed(rows, START, variances)
    for axis, step in enumerate(1e-5 * np.eye(6)):
        slope = (costs_after(rows, step, variances) - costs_after(rows, -step, variances)) / 2e-5
        # Outliers are judged anew a few times only.
        np.testing.assert_allclose(slope, gradient[:, axis], atol=0.01 * np.abs(gradient).max())


def test_scatter_is_what_the_best_fit_of_each_view_leaves(rng: np.random.Generator) -> None:
    rows = random_rows(rng, 1, 3, 6, size=0.3)
    squares, freedom = accumulate(rows, START).within_view_scatter()
    for view, count in enumerate(COUNTS):
        J, r = dense(rows, view)
        left = r - J @ np.linalg.lstsq(J, r, rcond=None)[0]
        assert squares[view] == pytest.approx(left @ left)
        assert freedom[view] == count - 3


def test_directions_that_no_measurement_tells_take_no_freedom(rng: np.random.Generator) -> None:
    rows = random_rows(rng, 1, 3, 6)
    rows.jacobian[..., 2] = 0
    assert accumulate(rows, START).within_view_scatter()[1].tolist() == [28, 5, 21]


def one_view(J: Array, r: Array) -> LinearizedResiduals:
    """A view whose measurements, a number each, depend on all of the pose."""
    return LinearizedResiduals(r[:, None], J[:, None], np.eye(6)[None])


FIRST = np.array([0])


def test_a_swaying_view_says_what_is_left_with_its_displacement_marginalised(rng: np.random.Generator) -> None:
    J, r = rng.normal(size=(20, 6)), 0.3 * rng.normal(size=20)
    A, sway = J.T @ J, np.array([0.1, 0.1, 0.1, 0.3, 0.3, 0.3])
    information, gradient, _ = swayed(one_view(J, r), FIRST, sway)
    expected = np.linalg.inv(np.linalg.inv(A) + np.diag(sway))
    np.testing.assert_allclose(information[0], expected, atol=1e-10)
    # Both say the same best displacement: -A⁻¹ b.
    np.testing.assert_allclose(
        np.linalg.solve(information[0], gradient[0]), np.linalg.solve(A, J.T @ r), atol=1e-8
    )


def test_a_swaying_view_that_fixes_not_all_leaves_the_rest_open(rng: np.random.Generator) -> None:
    J, sway = rng.normal(size=(20, 3)) @ rng.normal(size=(3, 6)), np.full(6, 0.2)
    information = swayed(one_view(J, np.zeros(20)), FIRST, sway)[0][0]
    # In the limit of hardly any information on the rest.
    limit = np.linalg.inv(np.linalg.inv(J.T @ J + 1e-7 * np.eye(6)) + np.diag(sway))
    np.testing.assert_allclose(information, limit, atol=1e-5)


def test_cost_of_a_swaying_view_is_the_least_over_its_displacement(rng: np.random.Generator) -> None:
    J, r, sway = rng.normal(size=(20, 6)), 0.3 * rng.normal(size=20), np.linspace(0.1, 0.5, 6)
    cost = swayed(one_view(J, r), FIRST, sway)[2][0]
    best = -np.linalg.solve(J.T @ J + np.diag(1 / sway), J.T @ r)
    left = r + J @ best
    assert cost == pytest.approx(0.5 * left @ left + 0.5 * best @ (best / sway))


def test_measurements_of_a_view_that_is_displaced_as_a_whole_are_no_outliers(rng: np.random.Generator) -> None:
    J = rng.normal(size=(40, 6))
    far = J @ np.full(6, 10.0) + 0.3 * rng.normal(size=40)
    information = swayed(one_view(J, far), FIRST, np.full(6, 100.0))[0]
    np.testing.assert_allclose(information, swayed(one_view(J, 0 * far), FIRST, np.full(6, 100.0))[0], rtol=1e-10)


def test_outliers_in_a_displaced_view_hardly_count(rng: np.random.Generator) -> None:
    J, noise = rng.normal(size=(40, 6)), 0.3 * rng.normal(size=40)
    noise[:3] = 1000
    information, gradient, _ = swayed(one_view(J, J @ np.full(6, 10.0) + noise), FIRST, np.full(6, 100.0))
    displaced = np.linalg.solve(information[0], gradient[0])
    np.testing.assert_allclose(displaced, 10.0, atol=1.0)


def test_without_sway_views_say_all_that_they_measure(rng: np.random.Generator) -> None:
    rows = random_rows(rng, 2, 6, 6)
    sums = accumulate(rows, START, lambda found: np.zeros_like(found.Jtr))
    information, gradient, costs = swayed(rows, START, np.zeros(6))
    np.testing.assert_allclose(information, sums.information, rtol=1e-12)
    np.testing.assert_allclose(gradient, sums.gradient, rtol=1e-12)
    np.testing.assert_allclose(costs, sums.robust_cost_offset + sums.squared_residuals / 2, rtol=1e-12)


def test_misfit_of_three_readings_of_one_number() -> None:
    """Of readings 0, 0 and 3 with unit noise the mean is 1: gradients 1, 1 and -2 with variance 2/3 each."""
    squared, freedom = consistency_statistic(
        np.ones((3, 1, 1)), np.full((3, 1, 1), 1 / 3), np.array([[1.0], [1.0], [-2.0]])
    )
    np.testing.assert_allclose(squared, [1.5, 1.5, 6.0])
    assert freedom.tolist() == [1, 1, 1]


def test_what_nothing_else_checks_cannot_misfit() -> None:
    """Of two numbers only the first is read twice."""
    information = np.tile(np.diag([1.0, 1.0]), (1, 1, 1))
    spread = np.diag([0.5, 1.0])[None]
    squared, freedom = consistency_statistic(information, spread, np.array([[1.0, 0.0]]))
    assert squared[0] == pytest.approx(2.0)
    assert freedom[0] == 1


def test_misfit_does_not_depend_on_units(rng: np.random.Generator) -> None:
    root, gradient = rng.normal(size=(9, 6)), rng.normal(size=(1, 6))
    A = (root.T @ root)[None]
    P: Array = np.asarray(0.3 * np.linalg.inv(A), dtype=np.float64)
    scale = 10.0 ** np.arange(-3, 3)
    D, D_inverse = np.diag(scale), np.diag(1 / scale)
    expected = consistency_statistic(A, P, gradient)[0]
    np.testing.assert_allclose(
        consistency_statistic(D @ A @ D, np.asarray(D_inverse @ P @ D_inverse), gradient @ D)[0],
        expected,
        rtol=1e-6,
    )


@pytest.mark.parametrize("dimension", [1, 2])
def test_scatter_that_huber_leaves_of_gaussian_noise(dimension: int) -> None:
    size = np.linalg.norm(np.random.default_rng(0).normal(size=(1_000_000, dimension)), axis=1)
    left = np.minimum(1, HUBER_THRESHOLD / size) * size**2
    standard_error = np.std(left) / dimension / 1000
    assert huber_variance_factor(dimension) == pytest.approx(left.mean() / dimension, abs=4 * standard_error)


@pytest.mark.parametrize("k", [1, 2])
def test_residuals_beyond_the_limit_pull_no_harder(k: int) -> None:
    far, farther = (
        swayed(
            LinearizedResiduals(np.full((1, k), size), np.ones((1, k, 1)), np.ones((1, 1, 6))),
            np.array([0]),
            np.zeros(6),
        )[1]
        for size in (10.0, 1000.0)
    )
    np.testing.assert_allclose(far, farther)
