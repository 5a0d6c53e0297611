"""From where the scene is viewed at first, and how long its axes are."""

from dataclasses import replace

import numpy as np

from calgraph.result import Calibration
from calgraph.result.sensor_pose import choose_axis_length
from calgraph.viewer.viewer import initial_view


def test_a_rig_without_boards_is_seen_from_behind_and_above(rig: Calibration) -> None:
    """As if boards were 2 m ahead of it, along the x axis of its root."""
    bare = replace(rig, pictures=replace(rig.pictures, board_outlines=()))
    middle = np.mean([sensor.T_root_sensor[:3, 3] for sensor in rig.sensors], axis=0)
    position, target = initial_view(bare)
    np.testing.assert_allclose(position - middle, [-2.2, 0.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(target - middle, [0.6, 0.0, 0.0], atol=1e-12)


def test_axes_have_a_length_where_no_neighbours_are_known(rig: Calibration) -> None:
    root, other = rig.sensors[:2]
    unknown = replace(other, T_root_sensor=np.full((4, 4), np.nan))
    assert choose_axis_length((root,), longest=1.0) == 0.25
    assert choose_axis_length((root, unknown), longest=1.0) == 0.25
