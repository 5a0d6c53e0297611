"""Cells of surfaces: moments against NumPy's covariances, planes and lines whose normals are known."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calgraph.geometry import Array
from calgraph.surfaces.flat_cells import (
    CellLimits,
    CellMoments,
    FlatCells,
    cell_keys,
    fit_flat_cells,
    merge_moments,
    sum_moments,
)

NOISE = 0.01


def fit(points: Array, cell: float = 1.0) -> FlatCells:
    return fit_flat_cells(sum_moments(points, cell), CellLimits(cell, 10, 0.1), 0.05)


def on_plane(normal: Array, center: Array, count: int, rng: np.random.Generator) -> Array:
    """Points with noise along the normal, within 0.4 m along the surface, 0.2 m along its first direction."""
    n = len(normal)
    basis = np.linalg.svd(normal[None])[2]
    local = rng.uniform(-0.4, 0.4, (count, n))
    local[:, 0] = rng.normal(0, NOISE, count)
    local[:, 1:2] /= n - 1
    return np.asarray(center + local @ basis)


@pytest.mark.parametrize("n", [2, 3])
def test_moments_add_up_over_parts(n: int, rng: np.random.Generator) -> None:
    points = rng.uniform(-3, 3, (500, n))
    expected = sum_moments(points, 0.7)
    found = merge_moments([sum_moments(part, 0.7) for part in (points[:100], points[100:120], points[120:])])
    np.testing.assert_array_equal(found.keys, expected.keys)
    for name in ("count", "first", "second"):
        assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-12)


@pytest.mark.parametrize("n", [2, 3])
def test_moments_of_a_cell_are_those_of_its_points(n: int, rng: np.random.Generator) -> None:
    points = rng.uniform(0, 1, (40, n)) - 1.0  # one cell, of negative coordinates
    moments: CellMoments = sum_moments(points, 1.0)
    assert len(moments.keys) == 1
    assert moments.count[0] == 40
    assert_allclose(moments.mean[0], points.mean(axis=0))
    values, axes = moments.principal
    assert_allclose(
        (axes * values[:, None, :]) @ axes.swapaxes(-1, -2), np.cov(points.T, bias=True)[None], atol=1e-14
    )
    assert np.all(np.diff(values[0]) >= 0)


def test_each_cell_has_its_key() -> None:
    corners: Array = 0.5 * np.stack(np.meshgrid(*[np.arange(-3.0, 3.0)] * 3), axis=-1).reshape(-1, 3)
    inside, opposite = cell_keys(corners + 0.01, 0.5), cell_keys(corners + 0.49, 0.5)
    np.testing.assert_array_equal(inside, opposite)
    assert len(np.unique(inside)) == len(corners)


@pytest.mark.parametrize("normal", [[0.6, 0.8], [1.0, 0.0], [0.6, 0.0, 0.8], [2 / 3, -1 / 3, 2 / 3]])
def test_a_patch_has_the_normal_thickness_and_extent_of_its_surface(
    normal: list[float], rng: np.random.Generator
) -> None:
    n = len(normal)
    center = np.full(n, 10.5)
    cells = fit(on_plane(np.array(normal), center, 4000, rng))
    assert len(cells.keys) == 1
    assert np.degrees(np.arccos(abs(cells.normals[0] @ normal))) < 0.3
    assert cells.thickness[0] == pytest.approx(NOISE, rel=0.05)
    uniform = 0.8 / np.sqrt(12)
    assert_allclose(cells.extent[0], [uniform / 2, uniform][3 - n :], rtol=0.05)
    assert_allclose(cells.axes[0].T @ cells.axes[0], np.eye(n), atol=1e-12)
    assert_allclose(cells.center[0], center, atol=0.02)
    assert cells.count[0] == 4000


def test_the_thickness_of_exact_planes_is_zero() -> None:
    """Rounding makes the least variance of some negative."""
    x = np.linspace(0.1, 0.9, 30)
    for slope in np.linspace(0, 0.4, 41):
        cells = fit(np.stack([100 + x, 50.2 + slope * x], axis=1))
        assert_allclose(cells.thickness, 0, atol=1e-4)
        assert len(cells.keys) == 1


def test_corners_needles_and_few_points_are_no_surfaces(rng: np.random.Generator) -> None:
    along, across = rng.uniform(0.1, 0.9, (2, 200))
    corner = np.concatenate([np.stack([along, 0.1 + 0 * along], 1), np.stack([0.1 + 0 * across, across], 1)])
    assert len(fit(corner).keys) == 0
    needle = np.stack([along, 0.5 + 0.05 * (across - 0.5), 0.5 + 0 * along], axis=1)
    assert len(fit(needle).keys) == 0
    wall = np.stack([along, 0.5 + 0 * along], axis=1)
    assert len(fit(wall[:9]).keys) == 0
    assert len(fit(wall[:10]).keys) == 1


def wall_cells() -> FlatCells:
    """Cells of 1 m of a line at y = 0.5, for x from 0 to 3 m; the middle one has no points below 1.5 m."""
    x = np.concatenate([np.linspace(0.05, 0.95, 20), np.linspace(1.5, 1.99, 20), np.linspace(2.05, 2.95, 20)])
    return fit(np.stack([x, np.full_like(x, 0.5)], axis=1))


def test_points_find_the_cell_that_they_are_in() -> None:
    points = np.array([[2.9, 0.1], [0.1, 0.9], [1.01, 0.99], [-0.1, 0.5], [0.5, 1.01], [3.5, 0.5]])
    cells = wall_cells()
    found = cells.find(points)
    np.testing.assert_array_equal(found[3:], -1)
    assert_allclose(cells.center[found[:3]], [[2.5, 0.5], [0.5, 0.5], [1.745, 0.5]])


def test_points_elsewhere_find_the_nearest_centre_within_a_distance() -> None:
    points = np.array([[2.5, 1.2], [2.5, 1.31], [-0.2, 0.5]])
    cells = wall_cells()
    found = cells.find_near(points, 0.8)
    np.testing.assert_array_equal(found[[1]], -1)
    assert_allclose(cells.center[found[[0, 2]]], [[2.5, 0.5], [0.5, 0.5]])


def test_the_own_cell_is_found_although_another_centre_is_nearer() -> None:
    cells = wall_cells()
    found = cells.find_near(np.array([[1.05, 0.5]]), 0.8)
    assert_allclose(cells.center[found], [[1.745, 0.5]])


def test_no_cells_find_nothing() -> None:
    cells = fit(np.zeros((1, 2)))
    points = np.zeros((4, 2))
    np.testing.assert_array_equal(cells.find(points), np.full(4, -1))
    np.testing.assert_array_equal(cells.find_near(points, 1.0), np.full(4, -1))
