"""Foreground of a cloud against the background."""

from time import perf_counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calgraph.config.settings import CloudBackgroundSettings, DetectionSettings
from calgraph.detection import learn_cloud_background
from calgraph.errors import InputError
from calgraph.sensors import PointCloud


def wall_cloud(rng: np.random.Generator, count: int = 20_000, noise: float = 0.015, x: float = 4.0) -> PointCloud:
    """A wall right on a border of voxels, the worst place for noise."""
    yz = rng.uniform(-2, 2, (count, 2))
    return PointCloud(0.0, "scanner", np.column_stack([x + rng.normal(0, noise, count), yz]))


def test_noise_at_the_border_of_a_voxel_is_background(rng: np.random.Generator) -> None:
    background = learn_cloud_background([wall_cloud(rng) for _ in range(3)])
    assert background.foreground(wall_cloud(rng).points).sum() == 0


def test_a_board_before_the_wall_is_foreground(rng: np.random.Generator) -> None:
    background = learn_cloud_background([wall_cloud(rng) for _ in range(3)])
    assert background.foreground(wall_cloud(rng, 1000, x=3.5).points).sum() == 1000


def test_points_behind_the_background_are_not_foreground(rng: np.random.Generator) -> None:
    background = learn_cloud_background([wall_cloud(rng) for _ in range(3)])
    behind = wall_cloud(rng, 1000, x=5.0).points
    assert background.foreground(behind * [1, 0.5, 0.5]).sum() == 0


def test_directions_without_background_are_foreground(rng: np.random.Generator) -> None:
    background = learn_cloud_background([wall_cloud(rng)])
    assert background.foreground(np.array([[-6.0, 0, 0], [0, -30.0, 2.0]])).tolist() == [True, True]


def test_subtracting_100000_points_is_quick(rng: np.random.Generator) -> None:
    background = learn_cloud_background([wall_cloud(rng, 100_000)])
    points = wall_cloud(rng, 100_000).points
    start = perf_counter()
    background.foreground(points)
    # 0.02 s on an idle machine.
    assert perf_counter() - start < 0.5


@given(st.lists(st.tuples(*[st.floats(-200, 200)] * 3), min_size=1, max_size=30), st.floats(0.02, 0.5))
def test_background_points_are_never_foreground(points: list[tuple[float, float, float]], voxel: float) -> None:
    cloud = PointCloud(0.0, "scanner", np.array(points))
    settings = DetectionSettings(cloud_background=CloudBackgroundSettings(voxel=voxel))
    assert not learn_cloud_background([cloud], settings).foreground(cloud.points).any()


def test_an_empty_cloud_window_is_named() -> None:
    with pytest.raises(InputError, match=r"capture\.background"):
        learn_cloud_background([PointCloud(0.0, "scanner", np.empty((0, 3)))])
