"""The static surroundings, learnt while people walk through the view."""

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.sensors import LaserScan
from calgraph.tracking.scan_stack import in_runs
from calgraph.tracking.static_scene import StaticScene, learn_static_scene

ANGLES = np.linspace(-1, 1, 201)


def learnt(ranges: Array) -> StaticScene:
    """The scene of one row of ranges (S, 201) a scan."""
    scene = learn_static_scene(in_runs(LaserScan(0.1 * k, "laser", ANGLES, row) for k, row in enumerate(ranges)))
    assert scene is not None
    return scene


def new(scene: StaticScene, ranges: Array | float) -> int:
    scan = LaserScan(0.0, "laser", ANGLES, np.broadcast_to(ranges, ANGLES.shape).astype(float))
    return int(scene.nearer.foreground(scan).sum())


@pytest.fixture
def wall(rng: np.random.Generator) -> Array:
    """(600, 201) ranges of a minute before a round wall at 4 m."""
    return np.asarray(4.0 + rng.normal(0, 0.02, (600, 201)))


def test_walkers_all_the_time_do_not_become_background(wall: Array) -> None:
    for k, row in enumerate(wall):
        # To and fro, before every beam for a seventh of the time.
        middle = int(100 + 95 * np.sin(0.05 * k))
        row[max(middle - 14, 0) : middle + 14] = 2.0 + 0.8 * np.sin(0.031 * k)
    scene = learnt(wall)
    assert new(scene, 2.0) == 201
    assert new(scene, 4.0) == 0


def test_somebody_who_stands_for_a_third_of_the_time_does_not_become_background(wall: Array) -> None:
    wall[200:400, 80:100] = 2.0
    assert new(learnt(wall), 2.0) == 201


def test_noise_is_rarely_new(wall: Array, rng: np.random.Generator) -> None:
    scene = learnt(wall)
    share = np.mean([new(scene, 4.0 + rng.normal(0, 0.02, 201)) for _ in range(100)]) / 201
    assert share < 1e-3


def test_an_edge_that_flickers_between_two_depths_is_background_at_both(
    wall: Array, rng: np.random.Generator
) -> None:
    wall[:, 120] = rng.choice([2.5, 4.0], 600)
    scene = learnt(wall)
    flicker = np.full(201, 4.0)
    flicker[120] = 2.5
    assert new(scene, flicker) == 0


def test_a_beam_that_answers_now_and_then_is_background_where_it_does(wall: Array) -> None:
    wall[np.arange(600) % 3 > 0, 50] = np.nan
    assert new(learnt(wall), 4.0) == 0


def test_returns_from_the_open_sky_are_new(wall: Array) -> None:
    wall[:, 100:] = np.inf
    assert new(learnt(wall), np.where(ANGLES > 0.001, 9.0, 4.0)) == 100


def test_the_range_noise_is_measured(wall: Array) -> None:
    assert learnt(wall).sigma == pytest.approx(0.02, rel=0.05)


def test_static_points_are_averaged(wall: Array) -> None:
    assert np.abs(np.linalg.norm(learnt(wall).points, axis=1) - 4.0).max() < 0.01


def test_static_points_come_in_order_of_angle(wall: Array) -> None:
    points = learnt(wall[:, ::-1]).points
    assert (np.diff(np.arctan2(points[:, 1], points[:, 0])) > 0).all()


def test_a_row_of_nan_parts_two_surfaces(wall: Array) -> None:
    wall[:, 90:110] -= 1.0
    assert np.isnan(learnt(wall).points).all(axis=1).sum() == 2


def test_scans_with_other_beams_are_matched_by_angle(wall: Array) -> None:
    """Every other scan comes backwards, and a few lack every other beam."""
    turned = [LaserScan(0.1 * k, "laser", ANGLES[::-1], row[::-1]) for k, row in enumerate(wall)]
    scans = [
        LaserScan(0.1 * k, "laser", ANGLES[::2], row[::2]) if k % 50 == 0 else turned[k] if k % 2 else plain
        for k, (row, plain) in enumerate(
            (row, LaserScan(0.1 * k, "laser", ANGLES, row)) for k, row in enumerate(wall)
        )
    ]
    scene = learn_static_scene(in_runs(scans))
    assert scene is not None
    assert new(scene, 2.0) == 201
    assert new(scene, 4.0) == 0


def test_no_scans_make_no_scene() -> None:
    assert learn_static_scene([]) is None


def test_scans_without_any_return_leave_everything_new() -> None:
    assert new(learnt(np.full((20, 201), np.inf)), 3.0) == 201
