"""Direction cells of clouds: spacing, means, normals."""

import numpy as np
import pytest

from calgraph.config.settings import DetectionSettings
from calgraph.geometry import Array
from calgraph.rig.detection.voxel_normals import make_cells

SETTINGS = DetectionSettings()


def wall(elevations: Array, azimuths: Array, tilt: float = 0.0) -> Array:
    """Points (N, 3) on a wall 3 m ahead, leaning back, ring by ring."""
    azimuth, elevation = (a.ravel() for a in np.meshgrid(azimuths, elevations))
    c = np.cos(elevation)
    directions = np.column_stack([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(elevation)])
    n = np.array([np.cos(tilt), 0.0, np.sin(tilt)])
    return np.asarray(directions * (3 * n[0] / (directions @ n))[:, None])


AZIMUTHS = np.radians(np.arange(-20, 20, 0.2))
DENSE = np.radians(np.arange(-10, 10, 0.2))
SPARSE = np.radians(np.arange(-10, 11, 2.0))


@pytest.mark.parametrize("tilt", [-0.5, 0.0, 0.4])
def test_normals_are_those_of_the_wall_and_point_at_the_sensor(tilt: float) -> None:
    for elevations in (DENSE, SPARSE):
        cells = make_cells(wall(elevations, AZIMUTHS, tilt), None, SETTINGS)
        assert cells is not None
        found = np.linalg.norm(cells.normals, axis=1) > 0
        assert found.mean() > 0.9
        np.testing.assert_allclose(cells.normals[found] @ [-np.cos(tilt), 0, -np.sin(tilt)], 1, atol=1e-6)
        assert cells.curvature[found].max() < 1e-6


def test_dense_clouds_have_cells_of_the_stated_angle() -> None:
    points = wall(DENSE, AZIMUTHS)
    cells = make_cells(points, None, SETTINGS)
    assert cells is not None
    assert cells.spacing == pytest.approx(np.radians(0.7), rel=0.2)
    # 40 by 20 degrees.
    assert len(cells.points) == pytest.approx(40 * 20 / 0.7**2, rel=0.15)
    np.testing.assert_allclose(cells.points[:, 0], 3.0, atol=1e-9)


def test_sparse_rings_are_the_rows_of_cells() -> None:
    cells = make_cells(wall(SPARSE, AZIMUTHS), None, SETTINGS)
    assert cells is not None
    assert cells.spacing == pytest.approx(np.radians(2.0), rel=0.01)
    # Along a ring, cells are a third of the spacing of rings wide.
    assert len(cells.points) == pytest.approx(11 * 40 / (2.0 / 3), rel=0.1)


def test_stated_rings_are_used_where_their_elevations_overlap(rng: np.random.Generator) -> None:
    """Elevations that scatter by half of the rings' spacing have no peaks."""
    rings = np.repeat(np.arange(11, dtype=np.int32), len(AZIMUTHS))
    jitter = rng.uniform(-1.0, 1.0, len(rings))
    azimuth = np.tile(AZIMUTHS, 11)
    elevation = np.repeat(SPARSE, len(AZIMUTHS)) + np.radians(jitter)
    points = 3 * np.column_stack([np.ones_like(azimuth), np.tan(azimuth), np.tan(elevation) / np.cos(azimuth)])
    stated, unstated = make_cells(points, rings, SETTINGS), make_cells(points, None, SETTINGS)
    assert stated is not None
    assert unstated is not None
    assert stated.spacing == pytest.approx(np.radians(2.0), rel=0.05)
    assert unstated.spacing < np.radians(1.5)


def test_each_point_lies_in_its_cell() -> None:
    points = wall(DENSE, AZIMUTHS)
    cells = make_cells(points, None, SETTINGS)
    assert cells is not None
    kept = cells.cell_of_point >= 0
    assert kept.mean() > 0.99
    away = np.linalg.norm(points[kept] - cells.points[cells.cell_of_point[kept]], axis=1)
    # Half the diagonal of a cell of 0.7 degrees at 3.3 m.
    assert away.max() < 0.035
    means = np.array([points[cells.cell_of_point == i].mean(axis=0) for i in range(0, len(cells.points), 50)])
    np.testing.assert_allclose(means, cells.points[::50], atol=1e-12)


def test_two_depths_in_one_direction_are_two_cells() -> None:
    near, far = wall(DENSE, AZIMUTHS), 1.2 * wall(DENSE, AZIMUTHS)
    cells = make_cells(np.concatenate([near, far]), None, SETTINGS)
    assert cells is not None
    assert set(np.round(cells.points[:, 0], 6)) == {3.0, 3.6}


def test_stray_points_are_dropped() -> None:
    points = np.concatenate([wall(DENSE, AZIMUTHS), [[1.0, 3.0, 2.0]]])
    cells = make_cells(points, None, SETTINGS)
    assert cells is not None
    assert cells.cell_of_point[-1] == -1
    assert (cells.cell_of_point[:-1] >= 0).mean() > 0.99


def test_points_on_a_line_have_no_normals() -> None:
    cells = make_cells(wall(np.zeros(1), AZIMUTHS), None, SETTINGS)
    assert cells is not None
    assert not cells.normals.any()
    assert np.isinf(cells.curvature).all()


@pytest.mark.parametrize("count", [1, 5])
def test_too_few_points_have_no_cells(count: int) -> None:
    assert make_cells(wall(np.zeros(1), np.radians(np.arange(count))), None, SETTINGS) is None
