"""The minimiser on problems with known solutions, against SciPy, and its damping rule."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import scipy.optimize

from calgraph.geometry import Array
from calgraph.solver.levenberg_marquardt import Damping, DenseLinearization, Minimum, minimize, minimize_batch


def rosenbrock(x: Array) -> DenseLinearization:
    a, b = x[..., 0], x[..., 1]
    r = np.stack([10 * (b - a**2), 1 - a], axis=-1)
    J = np.stack([np.stack([-20 * a, 10 + 0 * b], axis=-1), np.stack([-1 + 0 * a, 0 * b], axis=-1)], axis=-2)
    return DenseLinearization(r, J)


def exponential(x: Array) -> DenseLinearization:
    """A decay with offset, whose residuals do not vanish at the minimum."""
    t = np.linspace(0, 3, 12)
    y = 2 * np.exp(-1.3 * t) + 0.5 + 0.05 * np.sin(17 * t)
    decay = np.exp(-x[..., 1:2] * t)
    r = x[..., :1] * decay + x[..., 2:3] - y
    return DenseLinearization(r, np.stack([decay, -x[..., :1] * t * decay, np.ones_like(r)], axis=-1))


def solved(function: Any, start: list[float], **options: Any) -> Minimum[Array, DenseLinearization]:
    options = {"iterations": 100, "tolerance": 1e-20} | options
    return minimize(np.array(start), lambda x, _: function(x), np.add, **options)


def test_a_linear_problem_is_solved_in_one_step() -> None:
    """The mean of 1, 2 and 6 is 3, with a cost of half of 4 + 1 + 9."""
    found = solved(
        lambda x: DenseLinearization(x - np.array([1.0, 2.0, 6.0]), np.ones((3, 1))),
        [100.0],
        damping=0.0,
        tolerance=1e-9,
    )
    assert found.state == pytest.approx(3.0)
    assert found.linearization.cost == pytest.approx(7.0)
    assert found.converged
    assert found.iterations == 1


def test_rosenbrocks_valley_ends_at_one_one() -> None:
    found = solved(rosenbrock, [-1.2, 1.0])
    assert found.converged
    np.testing.assert_allclose(found.state, [1, 1], atol=1e-9)


@pytest.mark.parametrize("start", [[1.0, 1.0, 0.0], [5.0, 0.2, -2.0], [0.1, 4.0, 1.0]])
def test_minima_are_those_of_scipy(start: list[float]) -> None:
    found = solved(exponential, start)
    oracle = scipy.optimize.least_squares(
        lambda x: exponential(x).residual,
        start,
        jac=lambda x: exponential(x).jacobian,
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    assert found.converged
    np.testing.assert_allclose(found.state, oracle.x, atol=1e-7)


def test_a_batch_is_solved_as_its_problems_alone() -> None:
    starts = [[1.0, 1.0, 0.0], [5.0, 0.2, -2.0], [0.1, 4.0, 1.0]]
    states, at = minimize_batch(np.array(starts), exponential, np.add, iterations=100, relative_tolerance=1e-14)
    for state, cost, start in zip(states, at.cost, starts, strict=True):
        alone = solved(exponential, start)
        np.testing.assert_allclose(state, alone.state, atol=1e-6)
        assert cost == pytest.approx(alone.linearization.cost, rel=1e-12)


def test_infeasible_states_are_not_entered() -> None:
    def logarithm(x: Array) -> DenseLinearization:
        with np.errstate(invalid="ignore"):
            return DenseLinearization(np.log(x) + 3, 1 / x[:, None])

    # A full step from 1 ends at -2.
    found = solved(logarithm, [1.0])
    assert found.converged
    assert found.state == pytest.approx(np.exp(-3))


def test_a_start_that_is_not_feasible_is_returned() -> None:
    found = solved(lambda x: DenseLinearization(x * np.nan, np.ones((1, 1))), [1.0])
    assert (found.iterations, found.converged) == (0, False)
    states, _ = minimize_batch(
        np.array([[np.nan], [2.0]]),
        lambda x: DenseLinearization(x, np.ones((2, 1, 1))),
        np.add,
        iterations=9,
        relative_tolerance=1e-9,
    )
    np.testing.assert_allclose(states, [[np.nan], [0.0]], atol=1e-3)


def test_the_limit_on_iterations_is_reported() -> None:
    found = solved(rosenbrock, [-1.2, 1.0], iterations=3)
    assert (found.iterations, found.converged) == (3, False)


def test_a_gradient_of_the_wrong_sign_does_not_converge() -> None:
    found = solved(lambda x: DenseLinearization(x - 1, -np.ones((1, 1))), [5.0], tolerance=1e-6)
    assert not found.converged
    assert found.state == 5.0


@pytest.mark.parametrize(
    ("gain", "value", "growth"),
    [(1.0, 1 / 3, 2.0), (2.0, 1 / 3, 2.0), (0.5, 1.0, 2.0), (0.25, 1.125, 2.0), (0.0, 4.0, 8.0), (-3.0, 4.0, 8.0)],
)
def test_damping_follows_the_ratio_of_gains(gain: float, value: float, growth: float) -> None:
    """Algorithm 3.16: times max(1/3, 1 - (2 gain - 1)³), or times a growth that doubles with each rejection."""
    updated = Damping(1.0, 4.0).update(gain)
    assert updated.value == pytest.approx(value)
    assert updated.growth == growth


@dataclass(frozen=True, eq=False)
class Extrapolated(DenseLinearization):
    """DenseLinearization extrapolated from those at another state."""

    at: Array
    exact: bool = True


def test_extrapolated_linearizations_are_refined_at_the_minimum() -> None:
    exact_at: list[Array] = []

    def linearize(x: Array, near: Extrapolated | None) -> Extrapolated:
        if near is not None and np.abs(x - near.at).max() < 0.1:
            return replace(near, residual=near.residual + near.jacobian @ (x - near.at), at=x, exact=False)
        exact_at.append(x)
        there = exponential(x)
        return Extrapolated(there.residual, there.jacobian, x)

    def refine(x: Array, at: Extrapolated, settled: bool) -> Extrapolated | None:  # noqa: ARG001
        return None if at.exact else linearize(x, None)

    start = np.array([1.0, 1.0, 0.0])
    found = minimize(start, linearize, np.add, iterations=100, tolerance=1e-12, refine=refine)
    assert found.converged
    assert found.linearization.exact
    assert len(exact_at) < found.iterations
    np.testing.assert_allclose(found.state, solved(exponential, [1.0, 1.0, 0.0]).state, atol=1e-5)
    coarse = minimize(start, linearize, np.add, iterations=100, tolerance=1e-12)
    assert not coarse.linearization.exact


class SingularWithoutDamping(DenseLinearization):
    """Equations that a solver refuses, or solves with NaN, up to some damping."""

    def solve(self, damping: Any) -> tuple[Array, Any]:
        if damping < 1e-4:
            raise np.linalg.LinAlgError("Singular matrix")
        if damping < 1e-3:
            return np.full(3, np.nan), np.nan
        return super().solve(damping)


def test_equations_that_are_singular_are_damped_more() -> None:
    def linearize(x: Array, _near: SingularWithoutDamping | None) -> SingularWithoutDamping:
        there = exponential(x)
        return SingularWithoutDamping(there.residual, there.jacobian)

    start = np.array([1.0, 1.0, 0.0])
    found = minimize(start, linearize, np.add, iterations=200, tolerance=1e-20)
    np.testing.assert_allclose(found.state, solved(exponential, [1.0, 1.0, 0.0]).state, atol=1e-4)
