"""What is new against the background, for clouds and for scans."""

from time import perf_counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calgraph.detection import CloudBackground, ScanBackground
from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.sensors import LaserScan, PointCloud


def wall_cloud(rng: np.random.Generator, count: int = 20_000, noise: float = 0.015, x: float = 4.0) -> PointCloud:
    """A wall right on a border of voxels, the worst place for noise."""
    yz = rng.uniform(-2, 2, (count, 2))
    return PointCloud(0.0, "scanner", np.column_stack([x + rng.normal(0, noise, count), yz]))


def test_noise_at_a_voxels_border_does_not_let_the_background_through(rng: np.random.Generator) -> None:
    background = CloudBackground.build([wall_cloud(rng) for _ in range(3)])
    assert background.foreground(wall_cloud(rng).points).sum() == 0


def test_a_board_before_the_wall_is_new(rng: np.random.Generator) -> None:
    background = CloudBackground.build([wall_cloud(rng) for _ in range(3)])
    assert background.foreground(wall_cloud(rng, 1000, x=3.5).points).all()


def test_points_behind_the_background_are_not_new(rng: np.random.Generator) -> None:
    background = CloudBackground.build([wall_cloud(rng) for _ in range(3)])
    behind = wall_cloud(rng, 1000, x=5.0).points
    assert background.foreground(behind * [1, 0.5, 0.5]).sum() == 0


def test_directions_never_seen_before_are_new(rng: np.random.Generator) -> None:
    background = CloudBackground.build([wall_cloud(rng)])
    assert background.foreground(np.array([[-6.0, 0, 0], [0, -30.0, 2.0]])).all()


def test_subtracting_100000_points_is_quick(rng: np.random.Generator) -> None:
    background = CloudBackground.build([wall_cloud(rng, 100_000)])
    points = wall_cloud(rng, 100_000).points
    start = perf_counter()
    background.foreground(points)
    # 0.02 s on an idle machine.
    assert perf_counter() - start < 0.5


@given(st.lists(st.tuples(*[st.floats(-200, 200)] * 3), min_size=1, max_size=30), st.floats(0.02, 0.5))
def test_background_points_are_never_new(points: list[tuple[float, float, float]], voxel: float) -> None:
    cloud = PointCloud(0.0, "scanner", np.array(points))
    assert not CloudBackground.build([cloud], voxel).foreground(cloud.points).any()


def test_an_empty_cloud_window_is_named() -> None:
    with pytest.raises(InputError, match=r"capture\.background"):
        CloudBackground.build([PointCloud(0.0, "scanner", np.empty((0, 3)))])


ANGLES = np.linspace(-1, 1, 201)


def scan(ranges: Array | float, rng: np.random.Generator, noise: float = 0.02) -> LaserScan:
    return LaserScan(
        0.0, "laser", ANGLES, np.broadcast_to(ranges, ANGLES.shape) + rng.normal(0, noise, len(ANGLES))
    )


def test_a_nearer_beam_is_new(rng: np.random.Generator) -> None:
    background = ScanBackground.build([scan(4.0, rng) for _ in range(40)])
    ranges = np.where(np.abs(ANGLES) < 0.2, 2.0, 4.0)
    assert np.array_equal(background.foreground(scan(ranges, rng)), np.abs(ANGLES) < 0.2)


def test_noise_is_not_new(rng: np.random.Generator) -> None:
    background = ScanBackground.build([scan(4.0, rng) for _ in range(40)])
    new = np.mean([background.foreground(scan(4.0, rng)).mean() for _ in range(50)])
    assert new < 0.002


def test_the_margin_follows_a_noisier_scanner(rng: np.random.Generator) -> None:
    background = ScanBackground.build([scan(4.0, rng, 0.05) for _ in range(40)])
    new = np.mean([background.foreground(scan(4.0, rng, 0.05)).mean() for _ in range(50)])
    assert new < 0.005


def test_a_beam_that_flickers_between_two_depths_is_not_new_at_either_nor_between(
    rng: np.random.Generator,
) -> None:
    def flicker() -> LaserScan:
        edge = np.abs(ANGLES - 0.3) < 0.002
        return scan(np.where(edge, rng.choice([2.0, 5.0, rng.uniform(2, 5)]), 5.0), rng)

    background = ScanBackground.build([flicker() for _ in range(60)])
    assert not any(background.foreground(flicker())[130] for _ in range(60))
    assert background.foreground(scan(1.5, rng)).all()


def test_returns_where_nothing_ever_answered_are_new(rng: np.random.Generator) -> None:
    open_sky = np.where(ANGLES > 0, np.inf, 4.0)
    background = ScanBackground.build([scan(open_sky, rng) for _ in range(20)])
    assert background.foreground(scan(3.0, rng)).all()


def test_missing_returns_are_not_new(rng: np.random.Generator) -> None:
    background = ScanBackground.build([scan(4.0, rng) for _ in range(20)])
    nothing = LaserScan(0.0, "laser", ANGLES, np.where(ANGLES > 0, np.nan, np.inf))
    assert not background.foreground(nothing).any()


def test_a_single_stray_return_does_not_become_background(rng: np.random.Generator) -> None:
    dusty = [scan(4.0, rng) for _ in range(39)] + [scan(1.0, rng)]
    assert ScanBackground.build(dusty).foreground(scan(2.0, rng)).all()


def test_scans_with_other_beams_are_matched_by_angle(rng: np.random.Generator) -> None:
    background = ScanBackground.build([scan(4.0, rng) for _ in range(20)])
    half = LaserScan(0.0, "laser", ANGLES[::-2], np.where(ANGLES[::-2] > 0.5, 2.0, 4.0))
    assert np.array_equal(background.foreground(half), ANGLES[::-2] > 0.5)


def test_an_empty_scan_window_is_named() -> None:
    with pytest.raises(InputError, match=r"capture\.background"):
        ScanBackground.build([LaserScan(0.0, "laser", ANGLES, np.full(len(ANGLES), np.inf))])
