"""Foreground of a cloud against the background."""

from time import process_time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calgraph.config.settings import CloudBackgroundSettings, DetectionSettings
from calgraph.errors import InputError
from calgraph.rig.detection.background_learning import learn_cloud_background
from calgraph.rig.detection.capture_background import find_direction_cells, find_voxels, pack_voxels
from calgraph.sensors import PointCloud


def wall_cloud(rng: np.random.Generator, count: int = 20_000, noise: float = 0.015, x: float = 4.0) -> PointCloud:
    """A wall right on a border of voxels, the worst place for noise."""
    yz = rng.uniform(-2, 2, (count, 2))
    return PointCloud(0.0, "scanner", np.column_stack([x + rng.normal(0, noise, count), yz]))


def test_noise_at_the_border_of_a_voxel_is_background(rng: np.random.Generator) -> None:
    background = learn_cloud_background([wall_cloud(rng) for _ in range(3)], settings=DetectionSettings())
    assert background.foreground(wall_cloud(rng).points).sum() == 0


def test_a_board_before_the_wall_is_foreground(rng: np.random.Generator) -> None:
    background = learn_cloud_background([wall_cloud(rng) for _ in range(3)], settings=DetectionSettings())
    assert background.foreground(wall_cloud(rng, 1000, x=3.5).points).sum() == 1000


def test_a_board_that_comes_as_the_window_ends_is_no_background(rng: np.random.Generator) -> None:
    """It is in one sweep of twenty, and stands at the same place in a capture."""
    board = wall_cloud(rng, 1000, x=3.5)
    empty = [wall_cloud(rng) for _ in range(19)]
    both = PointCloud(0.0, "scanner", np.concatenate([wall_cloud(rng).points, board.points]))
    background = learn_cloud_background([*empty, both], settings=DetectionSettings())
    assert background.foreground(board.points).sum() == 1000
    # What every tenth sweep shows is there.
    background = learn_cloud_background([*empty[2:], both, both, both], settings=DetectionSettings())
    assert background.foreground(board.points).sum() == 0


def test_what_is_elsewhere_in_each_sweep_is_no_background() -> None:
    """As of a scanner that is carried around."""
    sweeps = [PointCloud(0.0, "scanner", np.array([[3.0 + k, 0.0, 0.0]])) for k in range(25)]
    background = learn_cloud_background(sweeps, settings=DetectionSettings())
    assert background.foreground(np.concatenate([one.points for one in sweeps])).all()


def test_points_behind_the_background_are_not_foreground(rng: np.random.Generator) -> None:
    background = learn_cloud_background([wall_cloud(rng) for _ in range(3)], settings=DetectionSettings())
    behind = wall_cloud(rng, 1000, x=5.0).points
    assert background.foreground(behind * [1, 0.5, 0.5]).sum() == 0


def test_directions_without_background_are_foreground(rng: np.random.Generator) -> None:
    background = learn_cloud_background([wall_cloud(rng)], settings=DetectionSettings())
    assert background.foreground(np.array([[-6.0, 0, 0], [0, -30.0, 2.0]])).tolist() == [True, True]


def test_subtracting_100000_points_is_quick(rng: np.random.Generator) -> None:
    background = learn_cloud_background([wall_cloud(rng, 100_000)], settings=DetectionSettings())
    points = wall_cloud(rng, 100_000).points
    start = process_time()
    background.foreground(points)
    # 0.02 s on an idle machine.
    assert process_time() - start < 0.5


@given(st.lists(st.tuples(*[st.floats(-200, 200)] * 3), min_size=1, max_size=30), st.floats(0.02, 0.5))
def test_background_points_are_never_foreground(points: list[tuple[float, float, float]], voxel: float) -> None:
    cloud = PointCloud(0.0, "scanner", np.array(points))
    settings = DetectionSettings(cloud_background=CloudBackgroundSettings(voxel=voxel))
    assert not learn_cloud_background([cloud], settings).foreground(cloud.points).any()


def test_an_empty_cloud_window_is_named() -> None:
    with pytest.raises(InputError, match=r"capture\.background"):
        learn_cloud_background([PointCloud(0.0, "scanner", np.empty((0, 3)))], settings=DetectionSettings())


def test_direction_cells_are_rows_of_elevation_and_columns_of_azimuth() -> None:
    points = np.array(
        [[1.0, 0, 0], [1, 0, 1.01], [0, 2, -0.01], [-1, -1e-9, 0], [0, 0, 5], [0, 0, -5], [-1, 1e-9, 0]]
    )
    row, column = find_direction_cells(points, (180, 360))
    np.testing.assert_array_equal(row, [90, 135, 89, 90, 179, 0, 90])
    np.testing.assert_array_equal(column[:4], [180, 180, 270, 0])
    assert column[6] == 359


def test_the_farthest_background_is_that_of_its_direction() -> None:
    """Walls at 3, 5 and 7 m to the front, left and right, and a ceiling at 2 m; each hides what is behind it."""
    y, z = (a.ravel() for a in np.meshgrid(np.arange(-0.3, 0.31, 0.05), np.arange(-0.3, 0.31, 0.05)))
    one = np.ones_like(y)
    walls = (np.column_stack([3 * one, y, z]), np.column_stack([y, 5 * one, z]), np.column_stack([y, -7 * one, z]))
    ceiling = np.column_stack([y, z, 2 * one])
    background = learn_cloud_background(
        [PointCloud(0.0, "scanner", np.vstack([*walls, ceiling]))], settings=DetectionSettings()
    )
    distances = np.array([1.9, 2.2, 2.7, 3.3, 4.7, 5.3, 6.7, 7.3])[:, None]
    for direction, farthest in (([1, 0, 0], 3), ([0, 1, 0], 5), ([0, -1, 0], 7)):
        foreground = background.foreground(distances * np.array(direction, dtype=float))
        np.testing.assert_array_equal(foreground, distances[:, 0] < farthest)
    foreground = background.foreground(np.array([[0, 0, 1.7], [0, 0, 2.3], [-3.0, 0, 0], [0, 0, -9]]))
    assert foreground.tolist() == [True, False, True, True]


@pytest.mark.parametrize(("behind", "foreground"), [(0.055, False), (0.16, False)])
def test_points_on_and_behind_a_wall_are_background(behind: float, foreground: bool) -> None:
    wall = wall_cloud(np.random.default_rng(0), noise=0.0)
    background = learn_cloud_background([wall], settings=DetectionSettings())
    assert (background.foreground(wall.points + np.array([behind, 0, 0])).mean() > 0.5) == foreground
    assert background.foreground(wall.points - np.array([0.16, 0, 0])).mean() > 0.95


def test_all_voxels_that_a_cube_of_a_voxel_around_a_point_meets_are_background(rng: np.random.Generator) -> None:
    voxel = 0.1
    borders = voxel / 2 * rng.integers(-4, 5, (60, 3))
    points = np.concatenate([borders, rng.uniform(-0.3, 0.3, (60, 3)), 1e4 * rng.normal(size=(20, 3))])
    background = learn_cloud_background([PointCloud(0.0, "scanner", points)], settings=DetectionSettings())
    corners = 0.499 * voxel * np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 1, 3)
    met = np.unique(pack_voxels(find_voxels((points + corners).reshape(-1, 3), voxel)))
    assert np.array_equal(background.keys, met)
