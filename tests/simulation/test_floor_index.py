"""The index of what is near on a floor."""

import numpy as np

from calgraph.geometry import Array
from calgraph.simulation.network_floor import Boxes, bound_polygons, group_by_tile


def random_boxes(rng: np.random.Generator) -> tuple[Array, Array]:
    """Lower left and upper right corners (300, 2) each, some of them long."""
    low = rng.uniform(-50, 50, (300, 2))
    return low, low + rng.uniform(0, 1, (300, 2)) * rng.choice([1.0, 30.0], (300, 1))


def test_the_boxes_that_touch_are_found(rng: np.random.Generator) -> None:
    low, high = random_boxes(rng)
    boxes = bound_polygons(np.stack([low, high], axis=1))
    for corner in rng.uniform(-50, 50, (50, 2)):
        touches = ((low <= corner + 7) & (high >= corner)).all(axis=1)
        assert boxes.near(corner, corner + 7).tolist() == np.flatnonzero(touches).tolist()


def test_a_box_that_is_nowhere_is_never_found() -> None:
    low = np.array([[0.0, 0.0], [np.nan, np.nan], [0.0, 0.0]])
    assert Boxes(low, low + 1).near(np.zeros(2), np.ones(2)).tolist() == [0, 2]


def test_tiles_hold_every_point_once_and_only_neighbours(rng: np.random.Generator) -> None:
    points = rng.uniform(-30, 30, (500, 2))
    tiles = group_by_tile(points)
    assert sorted(np.concatenate(tiles)) == list(range(500))
    assert max(np.ptp(points[tile], axis=0).max() for tile in tiles) <= 4.0


def test_no_points_are_in_no_tile() -> None:
    assert group_by_tile(np.zeros((0, 2))) == []
