"""The map of a drive in the viewer: placed by path and pose, and doubled by a displacement."""

import numpy as np
import pytest

from calgraph.geometry import se3, so3
from calgraph.viewer.colored_clouds import color_clouds, height_range, place_drive, sensor_color
from calgraph.viewer.panel import compute_misalignments, list_moments
from calgraph.viewer.view_state import ViewState, up_direction
from calgraph.viewer.viewer import initial_view
from driven_results import DURATION, REAR, driven


def test_the_map_is_relative_to_the_root_in_the_middle_of_its_part() -> None:
    calibration = driven()
    for name, x_root in place_drive(calibration, ViewState()):
        sides = np.abs(np.abs(x_root[:, 1]) - 3) < 1e-5
        assert sides.sum() >= 120, name
        assert x_root[sides, 0].min() < -DURATION / 4
        assert x_root[sides, 0].max() > DURATION / 4


def test_clouds_are_in_the_frames_of_their_sensors() -> None:
    calibration = driven()
    clouds = color_clouds(calibration, {}, ViewState(0), height_range(calibration))
    by_name = dict(place_drive(calibration, ViewState(0)))
    assert set(clouds) == {"front", "rear"}
    np.testing.assert_allclose(
        se3.apply(REAR, clouds["rear"].points.astype(np.float64)), by_name["rear"], atol=1e-5
    )
    assert np.unique(clouds["rear"].colors, axis=0).tolist() == [list(sensor_color(calibration, "rear"))]
    assert not color_clouds(calibration, {}, ViewState(1), (0, 1))


def test_colours_by_height_tell_the_floor_from_walls() -> None:
    calibration = driven()
    cloud = color_clouds(calibration, {}, ViewState(0, "height"), height_range(calibration))["rear"]
    floor = cloud.points[:, 2] < -0.9
    low = cloud.colors[floor].astype(float).mean(axis=0)
    high = cloud.colors[cloud.points[:, 2] > 0.4].astype(float).mean(axis=0)
    assert np.abs(low - high).max() > 80


def test_a_displaced_sensor_leaves_its_surfaces() -> None:
    """Sideways by 50 mm: its 120 points on walls of 200 are off by that."""
    calibration = driven()
    before = compute_misalignments(calibration, {}, ViewState())
    assert before["rear"].rms == pytest.approx(0.001)
    moved = ViewState(moved_sensor="rear", displacement=(0, 0.05, 0, 0, 0, 0))
    after = compute_misalignments(calibration, {}, moved)
    assert after["rear"].rms == pytest.approx(0.05 * np.sqrt(120 / 200), rel=0.02)
    assert after["front"].rms == pytest.approx(0.001)


def test_moments_are_parts_and_the_view_is_from_above() -> None:
    calibration = driven()
    assert list_moments(calibration) == [0.0]
    eye, target = initial_view(calibration)
    assert eye[2] > 10
    assert abs(target[2]) < 2


def test_upwards_is_that_of_the_level_world() -> None:
    calibration = driven()
    (path,) = calibration.pictures.drive_paths
    tilt = se3.pose(so3.exp(np.array([0.3, 0.0, 0.0])), np.zeros(3))
    path.T_world_root[:] = path.T_world_root @ tilt
    np.testing.assert_allclose(up_direction(calibration), [0, np.sin(0.3), np.cos(0.3)], atol=1e-9)
