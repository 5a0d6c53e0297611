"""Cubic B-splines: partition of unity, derivatives, and exact reproduction of cubics."""

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.network.joint.splines import Knots, evaluate_spline

KNOTS = Knots.spanning(3.0, 8.0, 0.2)
TIMES = np.linspace(3.0, 8.0, 401)


def cubic(times: Array) -> tuple[Array, Array]:
    """(N, 1) values of a cubic, and its slopes."""
    t = times[:, None] - 5.0
    return 2 - t + 0.5 * t**2 + 0.3 * t**3, -1 + t + 0.9 * t**2


def test_weights_add_up_to_one() -> None:
    _, weights, _ = KNOTS.basis_at(TIMES)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)


def test_weights_are_never_negative() -> None:
    assert KNOTS.basis_at(TIMES)[1].min() > -1e-12


def test_derivative_weights_add_up_to_zero() -> None:
    _, _, slopes = KNOTS.basis_at(TIMES)
    np.testing.assert_allclose(slopes.sum(axis=1), 0.0, atol=1e-12)


def test_derivative_weights_equal_finite_differences(rng: np.random.Generator) -> None:
    control, step = rng.normal(size=(KNOTS.count, 2)), 1e-5
    inside = TIMES[1:-1]
    ahead, behind = (evaluate_spline(control, *KNOTS.basis_at(inside + off)[:2]) for off in (step, -step))
    first, _, slopes = KNOTS.basis_at(inside)
    np.testing.assert_allclose(evaluate_spline(control, first, slopes), (ahead - behind) / (2 * step), atol=1e-7)


def test_derivatives_are_continuous_at_knots(rng: np.random.Generator) -> None:
    control = rng.normal(size=(KNOTS.count, 2))
    knots = np.linspace(3.2, 7.8, 24)
    (first, _, before), (second, _, after) = KNOTS.basis_at(knots - 1e-9), KNOTS.basis_at(knots + 1e-9)
    np.testing.assert_allclose(
        evaluate_spline(control, first, before), evaluate_spline(control, second, after), atol=1e-6
    )


@pytest.mark.parametrize("slope", [False, True])
def test_a_cubic_is_reproduced(slope: bool) -> None:
    # Control points of a cubic p on knots h apart are p - h² p'' / 6 (Marsden's identity).
    centres = KNOTS.control_times()
    bend = (1 + 1.8 * (centres - 5.0))[:, None]
    control = cubic(centres)[0] - 0.2**2 * bend / 6
    first, weights, slopes = KNOTS.basis_at(TIMES)
    np.testing.assert_allclose(
        evaluate_spline(control, first, slopes if slope else weights), cubic(TIMES)[slope], atol=1e-9
    )


def test_a_curve_without_duration_has_four_control_points() -> None:
    assert Knots.spanning(1.0, 1.0, 0.2).count == 4


def test_the_end_of_a_curve_belongs_to_it() -> None:
    first, weights, _ = KNOTS.basis_at(np.array([8.0]))
    assert first[0] <= KNOTS.count - 4
    assert weights.sum() == pytest.approx(1.0)
