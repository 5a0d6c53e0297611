"""Lines through neighbouring points of a scan."""

import numpy as np
import pytest

from calgraph.geometry import Array, fit_local_lines

WALL = np.column_stack([np.full(41, 2.0), np.linspace(-1, 1, 41)])


def fit(points: Array, max_gap: float = 0.2) -> Array:
    return fit_local_lines(points, np.full(len(points), max_gap))


def test_normals_point_at_the_scanner() -> None:
    np.testing.assert_allclose(fit(WALL)[3:-3], np.tile([-1.0, 0.0], (35, 1)), atol=1e-9)


def test_points_near_the_end_of_a_scan_have_no_line() -> None:
    assert np.isnan(fit(WALL)[[0, 1, 2, -3, -2, -1]]).all()


def test_lines_do_not_reach_over_breaks() -> None:
    broken = WALL.copy()
    broken[20] = np.nan
    assert np.isnan(fit(broken)[17:24]).all()
    assert np.isfinite(fit(broken)[[16, 24]]).all()


def test_lines_do_not_reach_over_gaps() -> None:
    gap = WALL.copy()
    gap[20:, 1] += 0.5
    assert np.flatnonzero(np.isnan(fit(gap)[3:-3, 0])).tolist() == list(range(14, 20))


def test_a_corner_is_no_line() -> None:
    corner = np.concatenate([WALL, np.column_stack([np.linspace(1.95, 1, 20), np.ones(20)])])
    assert np.isnan(fit(corner)[40]).all()


@pytest.mark.parametrize("count", [0, 6])
def test_few_points_have_no_lines(count: int) -> None:
    assert np.isnan(fit(WALL[:count])).all()
