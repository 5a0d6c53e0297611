"""Surfaces that sensors at rest share, without a trajectory."""

import numpy as np
from numpy.testing import assert_allclose
from scipy.sparse import csr_array, random_array

from calgraph.geometry import Array
from calgraph.surfaces.surface_elimination import NoiseModel, eliminate_surfaces, square_sparse
from calgraph.surfaces.surface_points import SurfacePoints, fit_surfaces

NOISE = NoiseModel(np.array([0.002, 0.002]), np.array([0.001, 0.001]))


def corner(rng: np.random.Generator) -> Array:
    """(400, 2) points of two walls, in the middle of cells of 0.5 m."""
    along, away = rng.uniform(0, 4, 400), np.full(400, 4.25)
    places = np.stack([along, away], axis=1)
    places[::2] = places[::2, ::-1]
    return places + rng.normal(0, 0.002, places.shape)


def test_sensors_at_rest_are_moved_onto_their_common_surfaces() -> None:
    rng = np.random.default_rng(5)
    shift = np.array([0.010, -0.006])
    world = np.concatenate([corner(rng), corner(rng) + shift])
    sensor = np.repeat([0, 1], 400)
    surfaces = fit_surfaces(world, sensor, 0.02)
    cell = surfaces.find(world)
    used = cell >= 0
    assert used.mean() > 0.9
    world, sensor, cell = world[used], sensor[used], cell[used]
    offset, axes = world - surfaces.center[cell], surfaces.axes[cell]
    normals, count = axes[:, :, 0], len(world)
    along = np.einsum("ni,ni->n", offset, axes[:, :, 1]) / surfaces.extent[cell, 0]
    at = SurfacePoints(
        sensor,
        cell,
        np.zeros(count),
        np.zeros(count, dtype=np.intp),
        np.einsum("ni,ni->n", offset, normals),
        np.column_stack([np.ones(count), along, np.ones(count)]),
        np.zeros(count, dtype=np.intp),
        np.zeros((count, 0)),
        normals,
    )
    free = np.array([[False, False], [True, True]])
    found = eliminate_surfaces(at, len(surfaces.center), NOISE, free, controls=0)
    step = -np.linalg.solve(found.information, found.gradient)
    assert found.information.shape == (2, 2)
    assert_allclose(step, -shift, atol=4 * np.sqrt(np.diag(np.linalg.inv(found.information))).max())
    assert np.sqrt(np.diag(np.linalg.inv(found.information))).max() < 0.002


def test_squares_of_sparse_rows_are_those_of_dense_ones() -> None:
    """More rows than are multiplied together, some without any entry."""
    F = csr_array(random_array((1300, 70), density=0.05, rng=np.random.default_rng(6)))
    assert 0 in np.diff(F.indptr)
    dense = F.toarray()
    assert_allclose(square_sparse(F), dense.T @ dense, atol=1e-12)
    assert_allclose(square_sparse(F[:0]), np.zeros((70, 70)))
