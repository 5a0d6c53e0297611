"""Ellipses: points on them, and the direct fit."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calgraph.geometry import Array, ellipse

SHAPE = np.array([3.0, -2.0, 0.4, 0.25, 0.15])
PHASES = np.linspace(-1.2, 1.8, 25)
ALL = np.ones(25, dtype=bool)


def test_points_at_phase_zero_lie_on_the_first_axis() -> None:
    expected = SHAPE[:2] + 0.25 * np.array([np.cos(0.4), np.sin(0.4)])
    np.testing.assert_allclose(ellipse.points(SHAPE, np.zeros(1))[0], expected)


@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(-1.5, 1.5), st.floats(0.1, 2.0), st.floats(0.3, 0.9))
def test_exact_points_give_their_ellipse_back(x: float, y: float, angle: float, a: float, ratio: float) -> None:
    shape = np.array([x, y, angle, a, ratio * a])
    fitted = ellipse.fit_direct(ellipse.points(shape, PHASES), ALL)
    np.testing.assert_allclose(fitted[[0, 1, 3, 4]], shape[[0, 1, 3, 4]], atol=1e-5)
    assert abs(np.sin(fitted[2] - angle)) < 1e-4


def test_groups_are_fitted_as_each_alone(rng: np.random.Generator) -> None:
    groups = ellipse.points(SHAPE + rng.uniform(0, 0.1, (4, 5)), np.broadcast_to(PHASES, (4, 25)))
    used = rng.uniform(size=(4, 25)) < 0.7
    together = ellipse.fit_direct(groups, used)
    alone = [
        ellipse.fit_direct(points[mask], ALL[: mask.sum()]) for points, mask in zip(groups, used, strict=True)
    ]
    np.testing.assert_allclose(together, alone, atol=1e-6)


def test_noise_far_from_the_origin_leaves_an_ellipse(rng: np.random.Generator) -> None:
    far = SHAPE + np.array([1e4, 1e4, 0, 0, 0])
    points = ellipse.points(far, np.linspace(-3, 3, 60)) + rng.normal(0, 0.005, (60, 2))
    fitted = ellipse.fit_direct(points, np.ones(60, dtype=bool))
    np.testing.assert_allclose(fitted[:2], far[:2], atol=0.01)


@pytest.mark.parametrize(
    "points",
    [
        np.stack([np.arange(9.0), 2 * np.arange(9.0)], axis=1),
        np.zeros((9, 2)),
        ellipse.points(SHAPE, np.linspace(0, 3, 5)),
    ],
    ids=["a line", "one point", "five points"],
)
def test_degenerate_points_give_nan(points: Array) -> None:
    assert np.isnan(ellipse.fit_direct(points, np.ones(len(points), dtype=bool))).all()
