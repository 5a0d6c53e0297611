"""From where the scene is first seen."""

from dataclasses import replace

import numpy as np

from calgraph.result import Calibration
from calgraph.viewer.viewer import initial_view


def test_a_rig_without_boards_is_seen_from_behind_and_above(rig: Calibration) -> None:
    """As if boards were 2 m ahead of it, along the x axis of its root."""
    bare = replace(rig, pictures=replace(rig.pictures, board_outlines=()))
    middle = np.mean([sensor.T_root_sensor[:3, 3] for sensor in rig.sensors], axis=0)
    position, target = initial_view(bare)
    np.testing.assert_allclose(position - middle, [-2.2, 0.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(target - middle, [0.6, 0.0, 0.0], atol=1e-12)
