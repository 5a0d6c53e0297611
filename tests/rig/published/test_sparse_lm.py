"""The solver on problems whose answer is known by hand, and against scipy."""

from collections.abc import Sequence

import numpy as np
import pytest
import scipy.optimize
from numpy.typing import NDArray

from calgraph.errors import CalibrationError
from calgraph.geometry import Array, se3, so3
from calgraph.rig.published.sparse_lm import Block, Term, Values, marginal_covariance, minimize_sparse


def add(values: Array, delta: Array) -> Array:
    return values + delta


class Linear:
    """y = A x with unit noise."""

    name = "linear"

    def __init__(self, A: Array, y: Array, index: NDArray[np.intp]) -> None:
        self.A, self.y, self.index = A, y, index

    def linearize(self, values: Values) -> tuple[Array, Sequence[Term]]:
        x = values["x"][self.index]
        return np.einsum("mki,mi->mk", self.A, x) - self.y, (Term("x", self.index, self.A),)


class Rosenbrock:
    """The valley (1 - x, 10 (y - x²))."""

    name = "valley"

    def linearize(self, values: Values) -> tuple[Array, Sequence[Term]]:
        x, y = values["x"][:, 0], values["x"][:, 1]
        J = np.zeros((len(x), 2, 2))
        J[:, 0, 0], J[:, 1, 0], J[:, 1, 1] = -1, -20 * x, 10
        return np.stack([1 - x, 10 * (y - x**2)], axis=1), (Term("x", np.arange(len(x)), J),)


class Alignment:
    """Points of b measured in a."""

    name = "alignment"

    def __init__(self, x_b: Array, x_a: Array) -> None:
        self.x_b, self.x_a = x_b, x_a

    def linearize(self, values: Values) -> tuple[Array, Sequence[Term]]:
        T = values["pose"][0]
        Rx = self.x_b @ T[:3, :3].T
        J = np.concatenate([np.broadcast_to(np.eye(3), (len(Rx), 3, 3)), -so3.hat(Rx)], axis=-1)
        return Rx + T[:3, 3] - self.x_a, (Term("pose", np.zeros(len(Rx), dtype=int), J),)


def test_linear_problem_is_solved_as_the_normal_equations_say(rng: np.random.Generator) -> None:
    A, y, index = rng.normal(size=(20, 3, 2)), rng.normal(size=(20, 3)), rng.integers(2, size=20)
    found = minimize_sparse({"x": np.zeros((2, 2))}, {"x": Block(2, add)}, [Linear(A, y, index)], iterations=50)
    for i in range(2):
        expected = np.linalg.lstsq(A[index == i].reshape(-1, 2), y[index == i].ravel(), rcond=None)[0]
        np.testing.assert_allclose(found.state["x"][i], expected, atol=1e-8)


def test_marginal_covariance_is_the_inverse_normal_matrix(rng: np.random.Generator) -> None:
    A, y, index = rng.normal(size=(20, 3, 2)), rng.normal(size=(20, 3)), rng.integers(2, size=20)
    blocks = {"x": Block(2, add)}
    covariance = marginal_covariance({"x": np.zeros((2, 2))}, blocks, [Linear(A, y, index)], "x", np.full(2, 1e6))
    rows = A[index == 1].reshape(-1, 2)
    np.testing.assert_allclose(covariance[2:, 2:], np.linalg.inv(rows.T @ rows), rtol=1e-6)


def test_direction_without_data_keeps_its_prior() -> None:
    A = np.array([[[1.0, 0.0]]])
    factor = Linear(A, np.zeros((1, 1)), np.zeros(1, dtype=int))
    covariance = marginal_covariance(
        {"x": np.zeros((1, 2))}, {"x": Block(2, add)}, [factor], "x", np.array([10.0, 10.0])
    )
    assert np.sqrt(covariance[1, 1]) == pytest.approx(10.0, rel=1e-3)


def test_curved_valley_from_the_classic_start() -> None:
    found = minimize_sparse({"x": np.array([[-1.2, 1.0]])}, {"x": Block(2, add)}, [Rosenbrock()], iterations=100)
    assert found.converged
    np.testing.assert_allclose(found.state["x"][0], [1, 1], atol=1e-6)


def test_fixed_variables_do_not_move() -> None:
    start = np.array([[-1.2, 1.0], [-1.2, 1.0]])
    found = minimize_sparse({"x": start}, {"x": Block(2, add, fixed=(0,))}, [Rosenbrock()], iterations=100)
    np.testing.assert_array_equal(found.state["x"][0], start[0])


@pytest.mark.parametrize("seed", range(5))
def test_pose_agrees_with_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = se3.pose(so3.exp(rng.normal(size=3)), rng.normal(size=3))
    x_b = rng.normal(size=(30, 3))
    factor = Alignment(x_b, se3.apply(truth, x_b) + rng.normal(size=(30, 3)) * 0.1)
    found = minimize_sparse({"pose": np.eye(4)[None]}, {"pose": Block(6, se3.retract)}, [factor], iterations=50)
    oracle = scipy.optimize.least_squares(
        lambda d: factor.linearize({"pose": se3.retract(np.eye(4)[None], d[None])})[0].ravel(),
        np.zeros(6),
        xtol=1e-14,
    )
    assert found.linearization.cost == pytest.approx(oracle.cost, rel=1e-9)


def test_residuals_that_are_not_finite_are_refused() -> None:
    with pytest.raises(CalibrationError, match="not finite"):
        minimize_sparse({"x": np.full((1, 2), np.nan)}, {"x": Block(2, add)}, [Rosenbrock()], iterations=50)
