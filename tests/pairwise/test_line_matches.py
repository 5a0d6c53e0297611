from collections.abc import Callable

import numpy as np
import pytest

from calgraph.geometry import Array, se3, so3
from calgraph.pairwise import evaluate_coplanarity


def numerical(f: Callable[[Array, Array], Array], x: Array, size: int) -> Array:
    h = 1e-6
    return np.stack([(f(x, h * e) - f(x, -h * e)) / (2 * h) for e in np.eye(size)], axis=-1)


@pytest.mark.parametrize("seed", range(5))
def test_coplanarity_derivatives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = se3.pose(so3.exp(rng.normal(size=3)), rng.normal(size=3))
    a, b = rng.normal(size=(2, 2, 3))
    _, by_pose, by_a, by_b = evaluate_coplanarity(T, a, b)
    np.testing.assert_allclose(
        by_pose, numerical(lambda T, d: evaluate_coplanarity(se3.retract(T, d), a, b)[0], T, 6), atol=1e-7
    )
    np.testing.assert_allclose(
        by_a, numerical(lambda a, d: evaluate_coplanarity(T, a + d.reshape(2, 3), b)[0], a, 6), atol=1e-7
    )
    np.testing.assert_allclose(
        by_b, numerical(lambda b, d: evaluate_coplanarity(T, a, b + d.reshape(2, 3))[0], b, 6), atol=1e-7
    )


def test_coplanarity_is_the_gap_along_the_intersection_of_the_scan_planes() -> None:
    """Scan planes that cross at right angles along x; both lines at 90 degrees to x, 0.1 m apart there."""
    T_a_b = se3.pose(so3.exp(np.array([np.pi / 2, 0, 0])), np.zeros(3))
    a = np.array([[1.0, -0.3, 0], [1.0, 0.3, 0]])
    b = np.array([[1.1, -0.3, 0], [1.1, 0.3, 0]])
    assert abs(evaluate_coplanarity(T_a_b, a, b)[0]) == pytest.approx(0.1)
