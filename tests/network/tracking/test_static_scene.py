"""The static background, learned while people walk through the view."""

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.network.tracking.scan_stack import stack_scans
from calgraph.network.tracking.static_scene import StaticScene, learn_static_scene
from calgraph.sensors import LaserScan

ANGLES = np.linspace(-1, 1, 201)


def learn(ranges: Array) -> StaticScene:
    """The scene of one row of ranges (S, 201) a scan."""
    scene = learn_static_scene(
        stack_scans(LaserScan(0.1 * k, "laser", ANGLES, row) for k, row in enumerate(ranges))
    )
    assert scene is not None
    return scene


def count_foreground(scene: StaticScene, ranges: Array | float) -> int:
    scan = LaserScan(0.0, "laser", ANGLES, np.broadcast_to(ranges, ANGLES.shape).astype(float))
    return int(scene.background.foreground(scan).sum())


@pytest.fixture
def wall(rng: np.random.Generator) -> Array:
    """(600, 201) ranges of a minute before a round wall at 4 m."""
    return np.asarray(4.0 + rng.normal(0, 0.02, (600, 201)))


def test_continuous_walking_does_not_become_background(wall: Array) -> None:
    for k, row in enumerate(wall):
        # To and fro, before every beam for a seventh of the time.
        middle = int(100 + 95 * np.sin(0.05 * k))
        row[max(middle - 14, 0) : middle + 14] = 2.0 + 0.8 * np.sin(0.031 * k)
    scene = learn(wall)
    assert count_foreground(scene, 2.0) == 201
    assert count_foreground(scene, 4.0) == 0


def test_a_person_standing_for_a_third_of_the_time_does_not_become_background(wall: Array) -> None:
    wall[200:400, 80:100] = 2.0
    assert count_foreground(learn(wall), 2.0) == 201


def test_range_noise_is_rarely_foreground(wall: Array, rng: np.random.Generator) -> None:
    scene = learn(wall)
    share = np.mean([count_foreground(scene, 4.0 + rng.normal(0, 0.02, 201)) for _ in range(100)]) / 201
    assert share < 1e-3


def test_an_edge_that_flickers_between_two_depths_is_background_at_both(
    wall: Array, rng: np.random.Generator
) -> None:
    wall[:, 120] = rng.choice([2.5, 4.0], 600)
    scene = learn(wall)
    flicker = np.full(201, 4.0)
    flicker[120] = 2.5
    assert count_foreground(scene, flicker) == 0


def test_an_intermittent_return_is_background(wall: Array) -> None:
    wall[np.arange(600) % 3 > 0, 50] = np.nan
    assert count_foreground(learn(wall), 4.0) == 0


def test_returns_where_there_was_none_are_foreground(wall: Array) -> None:
    wall[:, 100:] = np.inf
    assert count_foreground(learn(wall), np.where(ANGLES > 0.001, 9.0, 4.0)) == 100


def test_the_range_noise_is_measured(wall: Array) -> None:
    assert learn(wall).sigma == pytest.approx(0.02, rel=0.05)


def test_static_points_are_averaged(wall: Array) -> None:
    assert np.abs(np.linalg.norm(learn(wall).points, axis=1) - 4.0).max() < 0.01


def test_static_points_come_in_order_of_angle(wall: Array) -> None:
    points = learn(wall[:, ::-1]).points
    assert (np.diff(np.arctan2(points[:, 1], points[:, 0])) > 0).all()


def test_a_nan_row_separates_two_surfaces(wall: Array) -> None:
    wall[:, 90:110] -= 1.0
    assert np.isnan(learn(wall).points).all(axis=1).sum() == 2


def test_scans_with_other_beams_are_matched_by_angle(wall: Array) -> None:
    """Every other scan comes backwards, and a few lack every other beam."""
    turned = [LaserScan(0.1 * k, "laser", ANGLES[::-1], row[::-1]) for k, row in enumerate(wall)]
    scans = [
        LaserScan(0.1 * k, "laser", ANGLES[::2], row[::2]) if k % 50 == 0 else turned[k] if k % 2 else plain
        for k, (row, plain) in enumerate(
            (row, LaserScan(0.1 * k, "laser", ANGLES, row)) for k, row in enumerate(wall)
        )
    ]
    scene = learn_static_scene(stack_scans(scans))
    assert scene is not None
    assert count_foreground(scene, 2.0) == 201
    assert count_foreground(scene, 4.0) == 0


def test_no_scans_make_no_scene() -> None:
    assert learn_static_scene([]) is None


def test_without_any_return_everything_is_foreground() -> None:
    assert count_foreground(learn(np.full((20, 201), np.inf)), 3.0) == 201


@pytest.mark.parametrize(("distance", "count"), [(0.05, 0), (0.2, 201)])
def test_foreground_ends_clearly_before_the_background(
    distance: float, count: int, rng: np.random.Generator
) -> None:
    scene = learn(4.0 + rng.normal(0, 0.005, (600, 201)))
    assert count_foreground(scene, 4.0 - distance) == count
