"""Pictures of a network in space, from a simulated recording."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from calgraph.calibration.dispatch import calibrate
from calgraph.geometry import Array, se3
from calgraph.network.options import NetworkOptions
from calgraph.report.page import write_report
from calgraph.result import load_scene, save_scene
from calgraph.simulation import HallScenario, simulate_hall


@pytest.mark.slow
def test_plan_and_static_points_of_all_lidars_coincide_in_the_level_frame(tmp_path: Path) -> None:
    """To 0.3 degrees and 5 cm; it is written and read, and has a report."""
    hall = simulate_hall(HallScenario(seed=3, duration=15.0, lidars=("xt32", "xt32"), people=3, floor_slope=0.0))
    found = calibrate(hall.rig, hall.recording, NetworkOptions())
    pictures = found.pictures
    assert {view.sensor for view in pictures.floor_views} == {sensor.name for sensor in found.sensors}
    assert len(found.sensors) == 2
    T_true = hall.truth.T_world_root
    assert np.degrees(np.arccos(pictures.T_plan_root[2, :3] @ T_true[2, :3])) < 0.3
    assert abs(pictures.T_plan_root[2, 3] - T_true[2, 3]) < 0.05
    placed: list[Array] = []
    for view in pictures.floor_views:
        assert 1000 < len(view.points) <= 4000
        T = pictures.T_plan_root @ found[view.sensor].T_root_sensor
        placed.append(se3.apply(T, view.points.astype(np.float64)))
        heights = placed[-1][:, 2]
        assert np.sum(np.abs(heights) < 0.05) > 0.1 * len(heights)
        assert np.quantile(heights, 0.01) > -0.1
        assert view.tracks
        # Walls of the plan are above those points, too.
        level = cKDTree(placed[-1][:, :2])
        assert np.quantile(level.query(view.background)[0], 0.9) < 0.4
    first, second = (view.background for view in pictures.floor_views)
    assert np.median(cKDTree(first).query(second)[0]) < 0.15
    save_scene(pictures, tmp_path / "scene.npz")
    np.testing.assert_array_equal(load_scene(tmp_path / "scene.npz").T_plan_root, pictures.T_plan_root)
    write_report(found, hall.rig, tmp_path / "report.html")
    assert "3-D view" in (tmp_path / "report.html").read_text(encoding="utf-8")
