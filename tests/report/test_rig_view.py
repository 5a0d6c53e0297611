"""The 3-D view: positions of its objects."""

import dataclasses
import json
import re
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from calgraph.config import Rig
from calgraph.geometry import Array, se3, so3
from calgraph.report.rig_view import camera_frustum, ellipsoid_mesh, frame_axes, render_rig_view, scan_circle
from calgraph.result import Calibration
from calgraph.sensors import CameraModel

POSE = se3.pose(so3.exp(np.array([0.3, -0.7, 1.1])), np.array([1.0, -2.0, 0.5]))


def view(calibration: Calibration, rig: Rig) -> dict[str, Any]:
    html = render_rig_view(calibration, rig)
    content: dict[str, Any] = json.loads(html[html.index(">{") + 1 : html.index("</script>")])
    return content


def traces(calibration: Calibration, rig: Rig) -> dict[str, dict[str, Any]]:
    return {trace["name"]: trace for trace in view(calibration, rig)["data"] if trace["type"] == "scatter3d"}


def in_sensor(points: Array) -> Array:
    return se3.apply(se3.inverse(POSE), points)


def test_axes_start_at_the_sensor_and_point_along_it() -> None:
    ends = np.array([line[1] for line in frame_axes(POSE, 0.2)])
    np.testing.assert_allclose(in_sensor(ends), 0.2 * np.eye(3), atol=1e-12)


def test_a_frustum_ends_at_the_rays_of_the_corner_pixels() -> None:
    K = np.array([[500.0, 0, 300], [0, 400, 250], [0, 0, 1]])
    camera = CameraModel("pinhole", 640, 480, K, np.zeros(4))
    ring = in_sensor(camera_frustum(POSE, camera, 2.0)[0])
    pixels = ring[:4, :2] / ring[:4, 2:] * [500, 400] + [300, 250]
    np.testing.assert_allclose(pixels, [[0, 0], [640, 0], [640, 480], [0, 480]], atol=1e-9)


def test_a_frustum_of_unknown_intrinsics_is_60_degrees_wide() -> None:
    ring = in_sensor(camera_frustum(POSE, None, 1.0)[0])
    assert np.degrees(2 * np.arctan(ring[1, 0])) == pytest.approx(60)


def test_a_scan_circle_lies_in_the_scan_plane() -> None:
    circle = in_sensor(scan_circle(POSE, 3.0))
    np.testing.assert_allclose(circle[:, 2], 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(circle, axis=1), 3.0)


def test_an_ellipsoid_holds_95_percent(rng: np.random.Generator) -> None:
    root = rng.normal(size=(3, 3))
    covariance = root @ root.T
    vertices, _ = ellipsoid_mesh(np.ones(3), covariance, 1.0, np.inf)
    d = vertices - 1
    squared = np.einsum("ni,ij,nj->n", d, np.linalg.inv(covariance), d)
    np.testing.assert_allclose(squared, chi2.ppf(0.95, 3), rtol=1e-9)


@pytest.mark.parametrize("variance", [1e12, np.inf])
def test_an_ellipsoid_is_clipped_along_unobservable_directions(variance: float) -> None:
    vertices, _ = ellipsoid_mesh(np.zeros(3), np.diag([1e-6, 1e-6, variance]), 1.0, 2.0)
    assert np.ptp(vertices[:, 2]) == pytest.approx(4.0)
    assert np.ptp(vertices[:, 0]) < 0.01


def test_an_ellipsoid_is_closed() -> None:
    vertices, triangles = ellipsoid_mesh(np.zeros(3), np.eye(3), 1.0, np.inf)
    assert set(triangles.ravel()) == set(range(len(vertices)))


def test_every_sensor_is_named_at_its_position(calibration: Calibration, rig: Rig) -> None:
    named = traces(calibration, rig)["sensors"]
    i = named["text"].index("laser_low")
    np.testing.assert_allclose([named[k][i] for k in "xyz"], calibration["laser_low"].T_root_sensor[:3, 3])


def test_names_of_sensors_in_one_place_are_apart(calibration: Calibration, rig: Rig) -> None:
    stacked = tuple(dataclasses.replace(s, T_root_sensor=np.eye(4)) for s in calibration.sensors)
    named = traces(dataclasses.replace(calibration, sensors=stacked), rig)["sensors"]
    assert len(set(named["textposition"])) == len(calibration.sensors)


def test_all_boards_are_drawn(calibration: Calibration, rig: Rig) -> None:
    boards = traces(calibration, rig)["boards"]
    assert len(boards["x"]) == 6 * len(calibration.pictures.board_outlines)
    np.testing.assert_allclose(boards["z"][:4], calibration.pictures.board_outlines[0].corners[:, 2], rtol=1e-5)


def test_lines_of_different_objects_are_not_joined(calibration: Calibration, rig: Rig) -> None:
    assert traces(calibration, rig)["x axes"]["x"][2] is None


def test_ellipsoids_are_enlarged_by_the_stated_factor(calibration: Calibration, rig: Rig) -> None:
    (factor,) = re.findall(r"Ellipsoids are drawn enlarged <b>(\d+) ×</b>", render_rig_view(calibration, rig))
    meshes = [t for t in view(calibration, rig)["data"] if t["type"] == "mesh3d" and t.get("text") == "laser"]
    true, drawn = (np.array([mesh["x"], mesh["y"], mesh["z"]]) for mesh in meshes)
    center = calibration["laser"].T_root_sensor[:3, 3]
    np.testing.assert_allclose(drawn.T - center, int(factor) * (true.T - center), atol=1e-5 * int(factor))
    assert np.ptp(true[0]) == pytest.approx(2 * np.sqrt(chi2.ppf(0.95, 3)) * 0.0031, rel=0.02)
    assert [mesh["visible"] for mesh in meshes] == [False, True]


def test_visible_ellipsoids_are_to_scale(calibration: Calibration, rig: Rig) -> None:
    uncertain = dataclasses.replace(calibration, joint_covariance=1e4 * calibration.joint_covariance)
    html = render_rig_view(uncertain, rig)
    assert "Ellipsoids are drawn to scale." in html


def test_buttons_switch_the_uncertainties_only(calibration: Calibration, rig: Rig) -> None:
    content = view(calibration, rig)
    ours = {i for i, t in enumerate(content["data"]) if t["type"] == "mesh3d" and "name" in t}
    for choice in content["choices"][1]:
        assert {i for i, shown in enumerate(choice["visible"]) if shown is not None} == ours


def test_the_initial_view_contains_every_sensor(calibration: Calibration, rig: Rig) -> None:
    scene = view(calibration, rig)["layout"]["scene"]
    for sensor in calibration.sensors:
        for name, value in zip("xyz", sensor.T_root_sensor[:3, 3], strict=True):
            low, high = scene[f"{name}axis"]["range"]
            assert low < value < high


def test_sensors_in_one_place_are_drawn(calibration: Calibration, rig: Rig) -> None:
    stacked = tuple(dataclasses.replace(s, T_root_sensor=np.eye(4)) for s in calibration.sensors)
    assert len(traces(dataclasses.replace(calibration, sensors=stacked), rig)["sensors"]["x"]) == 5
