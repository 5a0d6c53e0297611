"""Flat regions of clouds."""

import numpy as np
import pytest

from calgraph.config.settings import DetectionSettings
from calgraph.geometry import Array
from calgraph.rig.detection.voxel_normals import Cells, grow_flat_regions, make_cells

SETTINGS = DetectionSettings()
Y, Z = (np.radians(a).ravel() for a in np.meshgrid(np.arange(-20, 20, 0.2), np.arange(-15, 15, 0.2)))


def cells(depth: Array) -> Cells:
    """Cells of a scene whose depths along x are given in the directions of Y and Z."""
    made = make_cells(depth[:, None] * np.column_stack([np.ones_like(Y), np.tan(Y), np.tan(Z)]), None, SETTINGS)
    assert made is not None
    return made


def regions(depth: Array, thickness: float = 0.03) -> list[Array]:
    """Points of the cells of each region, the largest first."""
    made = cells(depth)
    found = grow_flat_regions(made, thickness)
    return sorted((made.points[region] for region in found), key=len, reverse=True)


def test_a_wall_is_one_region() -> None:
    (wall,) = regions(np.full(len(Y), 3.0))
    assert len(wall) > 0.95 * len(cells(np.full(len(Y), 3.0)).points)


@pytest.mark.parametrize("step", [0.07, 0.15])
def test_a_step_in_depth_separates_two_regions(step: float) -> None:
    left, right, *rest = regions(np.where(Y < 0, 3.0, 3.0 + step))
    assert sum(map(len, rest)) < 0.1 * len(left)
    assert {round(float(np.median(part[:, 0])), 2) for part in (left, right)} == {3.0, round(3.0 + step, 2)}
    for part in (left, right):
        assert np.ptp(part[:, 0]) < 0.06


def test_a_step_below_the_thickness_does_not() -> None:
    (wall, *rest) = regions(np.where(Y < 0, 3.0, 3.02))
    assert sum(map(len, rest)) == 0
    assert np.ptp(wall[:, 1]) > 2.0


def test_two_walls_at_an_edge_are_two_regions() -> None:
    """Both are inclined by 30 degrees: their normals are 60 degrees apart."""
    depth = 3.0 / (1 + np.tan(np.radians(30)) * np.abs(np.tan(Y)))
    left, right, *rest = regions(depth)
    assert sum(map(len, rest)) < 0.1 * len(left)
    assert (np.median(left[:, 1]) > 0) != (np.median(right[:, 1]) > 0)


def test_round_things_are_no_region() -> None:
    """A ball of 0.15 m radius in front of nothing."""
    b = 1.5 / np.sqrt(1 + np.tan(Y) ** 2 + np.tan(Z) ** 2)
    inside = b**2 - 1.5**2 + 0.15**2
    hit = inside > 0
    ranges = b[hit] - np.sqrt(inside[hit])
    directions = np.column_stack([np.ones_like(Y), np.tan(Y), np.tan(Z)])[hit]
    made = make_cells(ranges[:, None] * directions / np.linalg.norm(directions, axis=1)[:, None], None, SETTINGS)
    assert made is not None
    for region in grow_flat_regions(made, 0.03):
        assert len(region) < 0.5 * len(made.points)


def test_fewer_cells_than_stated_are_no_region(monkeypatch: pytest.MonkeyPatch) -> None:
    small = np.hypot(Y, Z) < np.radians(1.0)
    points = 3.0 * np.column_stack([np.ones_like(Y), np.tan(Y), np.tan(Z)])[small]
    made = make_cells(points, None, SETTINGS)
    assert made is not None
    assert 5 < len(made.points) < 20
    monkeypatch.setattr("calgraph.rig.detection.voxel_normals._MIN_CELLS", len(made.points) + 1)
    assert grow_flat_regions(made, 0.03) == []
