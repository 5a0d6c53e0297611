"""The background of a 3-D LiDAR that is learned from its captures."""

import numpy as np
import pytest
from numpy.typing import NDArray

from calgraph.config import RangeNoise
from calgraph.config.settings import CaptureBackgroundSettings, DetectionSettings
from calgraph.geometry import Array
from calgraph.rig.detection.capture_background import CaptureBackground, learn_capture_background
from calgraph.sensors import PointCloud

NOISE = RangeNoise(range=0.01)
# Rings at whole degrees, at the border of direction cells of one degree.
AZIMUTH, ELEVATION = (a.ravel() for a in np.radians(np.meshgrid(np.arange(-40, 40, 0.2), np.arange(-10, 11, 2.0))))
DIRECTIONS = np.column_stack(
    [np.cos(AZIMUTH) * np.cos(ELEVATION), np.sin(AZIMUTH) * np.cos(ELEVATION), np.sin(ELEVATION)]
)
WALL = 5 / DIRECTIONS[:, 0]
PLACES = np.radians(np.linspace(-30, 30, 12))


def on_board(bearing: float) -> NDArray[np.bool_]:
    """Beams that meet a board of 12°."""
    return np.asarray(np.abs(AZIMUTH - bearing) < np.radians(6))


def cloud(ranges: Array, rng: np.random.Generator) -> PointCloud:
    """The beams that have a finite range."""
    measured = np.isfinite(ranges)
    noisy = ranges[measured] + rng.normal(0, NOISE.range, measured.sum())
    # Beams jitter by as much as they are written with.
    jitter = rng.normal(0, 1e-7, (measured.sum(), 3))
    return PointCloud(0.0, "lidar", noisy[:, None] * (DIRECTIONS[measured] + jitter))


def learned(clouds: list[PointCloud], settings: DetectionSettings = DetectionSettings()) -> CaptureBackground:
    return learn_capture_background(clouds, NOISE, settings)


def test_a_board_that_moves_is_in_front_of_what_its_captures_share(rng: np.random.Generator) -> None:
    clouds = [cloud(np.where(on_board(bearing), 2.5, WALL), rng) for bearing in PLACES]
    background = learned(clouds)
    for one in clouds:
        foreground = background.foreground(one.points)
        board = np.linalg.norm(one.points, axis=1) < 3
        assert foreground[board].all()
        assert foreground[~board].mean() < 0.01


def test_a_board_is_in_front_of_a_wall_by_more_than_the_wall_varies_in_a_cell(rng: np.random.Generator) -> None:
    background = learned([cloud(WALL, rng) for _ in range(12)])
    assert background.foreground(cloud(WALL - 0.2, rng).points).all()
    assert background.foreground(cloud(WALL, rng).points).mean() < 0.01


def test_directions_without_return_are_free(rng: np.random.Generator) -> None:
    """Against the sky, a board is the only thing that its directions ever measure."""
    sky = np.full(len(WALL), np.inf)
    clouds = [cloud(np.where(on_board(bearing), 2.5, sky), rng) for bearing in PLACES]
    assert all(learned(clouds).foreground(one.points).all() for one in clouds)


@pytest.mark.parametrize(("captures", "is_background"), [(10, False), (12, True)])
def test_a_board_in_one_place_is_background_only_if_no_capture_measures_behind_it(
    captures: int, is_background: bool, rng: np.random.Generator
) -> None:
    still = np.where(on_board(0.0), 2.5, WALL)
    clouds = [cloud(still if i < captures else WALL, rng) for i in range(12)]
    foreground = learned(clouds).foreground(clouds[0].points)
    board = np.linalg.norm(clouds[0].points, axis=1) < 3
    assert foreground[board].mean() == pytest.approx(0.0 if is_background else 1.0, abs=0.02)


def test_a_sensor_that_moves_learns_nothing(rng: np.random.Generator) -> None:
    clouds = [cloud(distance * WALL, rng) for distance in np.linspace(0.5, 1.5, 12)]
    background = learned(clouds)
    assert all(background.foreground(one.points).all() for one in clouds)


def test_returns_from_the_housing_hide_nothing(rng: np.random.Generator) -> None:
    housing = [
        PointCloud(0.0, "lidar", np.vstack([one.points, 0.02 * DIRECTIONS])) for one in [cloud(WALL, rng)] * 8
    ]
    assert learned(housing).foreground(cloud(WALL - 0.5, rng).points).all()


def test_few_captures_do_not_show_what_is_static(rng: np.random.Generator) -> None:
    clouds = [cloud(WALL, rng)] * 7
    assert learned(clouds).foreground(clouds[0].points).all()
    fewer = DetectionSettings(capture_background=CaptureBackgroundSettings(min_captures=7))
    assert not learned(clouds, fewer).foreground(clouds[0].points).any()
