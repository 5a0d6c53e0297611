"""Surfaces that sensors at rest share, without a trajectory."""

import numpy as np
from numpy.testing import assert_allclose

from calgraph.geometry import Array
from calgraph.surfaces.surface_elimination import NoiseModel, eliminate_surfaces
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
