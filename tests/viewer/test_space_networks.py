"""A network in space in the viewer: level though the root is not."""

import numpy as np
import pytest

from calgraph.geometry import se3
from calgraph.viewer.colored_clouds import color_clouds, height_range, sensor_color
from calgraph.viewer.trails import compute_trails
from calgraph.viewer.view_state import ViewState, up_direction
from calgraph.viewer.viewer import initial_view
from space_results import T_PLAN_OTHER, T_PLAN_ROOT, hall, surfaces


def test_up_is_the_normal_of_the_floor() -> None:
    np.testing.assert_allclose(T_PLAN_ROOT[:3, :3] @ up_direction(hall()), [0, 0, 1], atol=1e-12)


def test_walks_are_on_the_floor_of_the_hall() -> None:
    """At 3 s the person is 5 m along the hall."""
    people = compute_trails(hall(), ViewState(3.0))["other"].people
    np.testing.assert_allclose(se3.apply(T_PLAN_OTHER, people.astype(float)), [[5, 4, 0]], atol=1e-5)


def test_clouds_are_static_points_by_sensor_or_by_height() -> None:
    calibration = hall()
    heights = height_range(calibration)
    assert heights[1] - heights[0] == pytest.approx(5, abs=0.01)
    cloud = color_clouds(calibration, {}, ViewState(), heights)["other"]
    np.testing.assert_allclose(se3.apply(T_PLAN_OTHER, cloud.points.astype(float)), surfaces(), atol=1e-5)
    assert np.unique(cloud.colors, axis=0).tolist() == [list(sensor_color(calibration, "other"))]
    by_height = color_clouds(calibration, {}, ViewState(coloring="height"), heights)["other"].colors
    assert len(np.unique(by_height[:200], axis=0)) == 1
    # Blue floors and red ceilings.
    assert by_height[0, 2] > by_height[0, 0]
    assert by_height[-1, 0] > by_height[-1, 2]


def test_the_hall_is_viewed_from_above_its_middle() -> None:
    eye, target = se3.apply(T_PLAN_ROOT, np.array(initial_view(hall())))
    assert 4 < target[0] < 6
    assert abs(target[2]) < 1e-9
    assert eye[2] > 5
