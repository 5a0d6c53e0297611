"""Points of the clouds and their colours."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.geometry import se3
from calgraph.result import Calibration
from calgraph.sensors import CameraModel
from calgraph.viewer.colored_clouds import color_by_height, color_clouds, height_range, sensor_color
from calgraph.viewer.view_state import Coloring, ViewState, displaced_poses

HEIGHTS = (-1.0, 2.0)
BOARD = slice(0, 500)
"""The points of the LiDAR's clouds that are on the board; those of the wall follow."""

Cameras = dict[str, CameraModel]


def test_one_capture_shows_its_measurements(rig: Calibration, cameras: Cameras) -> None:
    shown = color_clouds(rig, cameras, ViewState(2.0), HEIGHTS)
    assert set(shown) == {"lidar", "laser"}
    np.testing.assert_array_equal(shown["lidar"].points, rig.pictures.snapshots[8].points)


def test_all_captures_together_are_all_their_points(rig: Calibration, cameras: Cameras) -> None:
    shown = color_clouds(rig, cameras, ViewState(None), HEIGHTS)
    assert len(shown["lidar"].points) == sum(len(s.points) for s in rig.pictures.snapshots if s.sensor == "lidar")


def test_a_long_recording_is_thinned(rig: Calibration, cameras: Cameras) -> None:
    many = replace(
        rig,
        pictures=replace(
            rig.pictures, snapshots=tuple(replace(rig.pictures.snapshots[0], capture=k) for k in range(200))
        ),
    )
    shown = color_clouds(many, cameras, ViewState(None), HEIGHTS)["lidar"]
    assert 75_000 < len(shown.points) <= 150_000
    assert len(shown.colors) == len(shown.points)


def test_by_sensor_each_has_a_different_colour(rig: Calibration, cameras: Cameras) -> None:
    shown = color_clouds(rig, cameras, ViewState(0.0, "sensor"), HEIGHTS)
    assert np.unique(shown["lidar"].colors, axis=0).tolist() == [list(sensor_color(rig, "lidar"))]
    assert sensor_color(rig, "lidar") != sensor_color(rig, "laser")


def test_points_take_the_colours_of_the_image(rig: Calibration, cameras: Cameras) -> None:
    """The part of the board with y > 0 is on the left of the image, which is red, y < 0 on the green part."""
    shown = color_clouds(rig, cameras, ViewState(0.0, "camera"), HEIGHTS)["lidar"]
    points, colors = shown.points[BOARD], shown.colors[BOARD].astype(int)
    left, right = colors[points[:, 1] > 0.02], colors[points[:, 1] < -0.02]
    assert np.abs(left - [220, 0, 0]).max() < 12
    assert np.abs(right - [0, 220, 0]).max() < 12


def test_occluded_points_are_not_coloured(rig: Calibration, cameras: Cameras) -> None:
    """The board at 3 m occludes twice its size of the wall at 6 m; beside it the wall is coloured."""
    shown = color_clouds(rig, cameras, ViewState(0.0, "camera"), HEIGHTS)["lidar"]
    wall, colors = shown.points[500:], shown.colors[500:]
    offset = np.abs(wall[:, 1:] - [0, -0.5])
    hidden = (offset < [0.8, 0.6]).all(axis=1)
    beside = (wall[:, 2] > 0.6) & (wall[:, 2] < 1.5) & (np.abs(wall[:, 1]) < 3)
    assert set(map(tuple, colors[hidden].tolist())) == {(92, 96, 104)}
    assert (colors[beside].max(axis=1) > 200).all()


def test_a_displaced_camera_colours_other_points(rig: Calibration, cameras: Cameras) -> None:
    """Turned by 2° to the left, at 3 m the border of red and green is 0.1 m further left."""
    turned = ViewState(0.0, "camera", "camera/front *1*", (0, 0, 0, 0, 0, float(np.radians(2))))
    shown = color_clouds(rig, cameras, turned, HEIGHTS)["lidar"]
    colors = shown.colors[BOARD].astype(int)
    red = colors[:, 0] > colors[:, 1]
    assert shown.points[BOARD][red, 1].min() == pytest.approx(3 * np.tan(np.radians(2)), abs=0.04)


def test_a_moved_scanner_takes_its_points_along(rig: Calibration, cameras: Cameras) -> None:
    choice = ViewState(1.0, "sensor", "laser", (0.1, 0, 0, 0, 0, 0))
    shown = color_clouds(rig, cameras, choice, HEIGHTS)["laser"]
    before, after = displaced_poses(rig, ViewState(1.0))["laser"], displaced_poses(rig, choice)["laser"]
    points = shown.points.astype(float)
    np.testing.assert_allclose(
        se3.apply(after, points), se3.apply(before, points) + np.array([0.1, 0, 0]), rtol=0, atol=1e-12
    )


def test_heights_go_from_blue_to_red() -> None:
    low, high = color_by_height(np.array([-9.0, 9.0]), HEIGHTS).astype(int)
    assert low[2] > low[0]
    assert high[0] > high[2]


def test_the_height_range_spans_nearly_all_points(rig: Calibration) -> None:
    low, high = height_range(rig)
    assert -1.01 < low < -0.8
    assert 1.7 < high < 2.01


def test_the_height_range_without_points(rig: Calibration) -> None:
    low, high = height_range(replace(rig, pictures=replace(rig.pictures, snapshots=())))
    assert high > low


def test_height_of_a_rig_whose_root_is_a_camera_is_against_its_y(rig: Calibration) -> None:
    T = se3.inverse(rig["camera/front *1*"].T_root_sensor)
    sensors = tuple(
        replace(s, T_root_sensor=T @ s.T_root_sensor, parent=None if s.kind == "camera" else "camera/front *1*")
        for s in rig.sensors
    )
    camera_rooted = replace(rig, root="camera/front *1*", sensors=sensors)
    assert height_range(camera_rooted) == pytest.approx(np.add(height_range(rig), 0.5), abs=1e-6)


@pytest.mark.parametrize("coloring", ["camera", "height", "sensor"])
@pytest.mark.parametrize("moment", [None, 0.0, 77.0])
def test_results_without_images_or_points(rig: Calibration, coloring: Coloring, moment: float | None) -> None:
    bare = replace(
        rig,
        pictures=replace(
            rig.pictures,
            snapshots=tuple(replace(s, image=b"", points=s.points[:0]) for s in rig.pictures.snapshots),
        ),
    )
    assert color_clouds(bare, {}, ViewState(moment, coloring), HEIGHTS) == {}


def test_a_network_shows_its_static_background(network: Calibration) -> None:
    shown = color_clouds(network, {}, ViewState(3.0), HEIGHTS)["b"]
    x_root = se3.apply(network["b"].T_root_sensor, shown.points.astype(float))
    np.testing.assert_allclose(x_root[:, :2], network.pictures.floor_views[1].background, rtol=0, atol=1e-5)
    assert np.abs(x_root[:, 2]).max() < 1e-9
