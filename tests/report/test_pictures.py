"""Images in the report: predicted boards, points by residual, fused colours, thumbnails."""

import base64
import dataclasses
import json
import re
from html import unescape
from typing import Any

import cv2
import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.geometry import Array, se3
from calgraph.report.fused_view import _color_points, render_fused_cloud
from calgraph.report.gallery import render_gallery, render_thumbnail
from calgraph.report.image_view import compute_overlay, render_camera_images
from calgraph.result import Calibration, Correction, EstimatedParameter, Snapshot
from calgraph.result.calibrated_cameras import calibrated_cameras


def colored_traces(html: str) -> list[dict[str, Any]]:
    """The traces whose points have a colour each."""
    return [t for t in data_of(html)["data"] if t.get("name") == "in an image"]


def data_of(html: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(re.findall(r"<script[^>]*>(.*?)</script>", html, re.DOTALL)[0])
    return content


def decoded(url: str) -> Any:
    data = np.frombuffer(base64.b64decode(url.split(",")[1]), dtype=np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_UNCHANGED)


def first_capture_of(pictured: Calibration, camera: str) -> int:
    """The first capture with a detection of a camera."""
    return next(view.capture for view in pictured.pictures.board_views if view.sensor == camera)


def test_the_board_is_drawn_at_its_predicted_pose(pictured: Calibration, rig: Rig) -> None:
    camera, capture = calibrated_cameras(pictured, rig)["camera"], first_capture_of(pictured, "camera")
    drawn = compute_overlay(pictured, rig, pictured["camera"], camera, capture)
    corners = next(o.corners for o in pictured.pictures.board_outlines if o.capture == capture)
    expected = camera.project(se3.apply(se3.inverse(pictured["camera"].T_root_sensor), corners))
    (outline,) = drawn.board_outlines
    inside = camera.contains(expected)
    assert inside.any()
    np.testing.assert_allclose(outline[::12][:4][inside], expected[inside], atol=1e-9)


def test_marks_are_drawn_where_corners_are_predicted(pictured: Calibration, rig: Rig) -> None:
    camera, capture = calibrated_cameras(pictured, rig)["camera"], first_capture_of(pictured, "camera")
    drawn = compute_overlay(pictured, rig, pictured["camera"], camera, capture)
    (tag,) = drawn.marks
    np.testing.assert_allclose(tag[::12][:4], drawn.measured - drawn.residuals, atol=1e-9)


def test_points_of_all_scanners_lie_on_the_board(pictured: Calibration, rig: Rig) -> None:
    """In captures with odd numbers, which three scanners detected."""
    camera = calibrated_cameras(pictured, rig)["camera"]
    odd = [v.capture for v in pictured.pictures.board_views if v.sensor == "camera" and v.capture % 2]
    every = [compute_overlay(pictured, rig, pictured["camera"], camera, capture) for capture in odd]
    drawn = next(one for one in every if np.isfinite(one.board_outlines[0]).all())
    assert len(drawn.points) == 3 * 80
    inside = drawn.points[np.isfinite(drawn.points[:, 0])]
    hull = cv2.convexHull(drawn.board_outlines[0].astype(np.float32))
    # Points are off the plane by millimetres, which is a few pixels at most.
    off = [cv2.pointPolygonTest(hull, point, True) for point in inside.astype(float).tolist()]
    assert min(off) > -15


def test_images_are_sorted_by_error(pictured: Calibration, rig: Rig) -> None:
    errors = re.findall(
        r"reprojection error ([\d.]+) px RMS", render_camera_images(pictured, rig).split("camera_rear")[0]
    )
    assert len(errors) > 1
    assert [float(e) for e in errors] == sorted(map(float, errors), reverse=True)


def test_errors_are_enlarged_by_the_stated_factor(pictured: Calibration, rig: Rig) -> None:
    html = render_camera_images(pictured, rig)
    capture, factor = re.findall(r"Capture (\d+)</b>.*?enlarged (\d+) ×", html)[0]
    path = re.findall(r'<path class="error" d="(.*?)"', html)[0]
    ends = np.array([[float(x) for x in pair.split()] for pair in re.findall(r"[ML]([-\d. ]+)", path)])
    view = next(v for v in pictured.pictures.board_views if (v.capture, v.sensor) == (int(capture), "camera"))
    assert view.residuals is not None
    np.testing.assert_allclose(ends[1::2] - ends[::2], int(factor) * view.residuals, atol=0.11)


def test_points_are_coloured_by_their_distance(pictured: Calibration, rig: Rig) -> None:
    """Half of the points of every view lie far in front of the board, half far behind it."""
    split = tuple(
        v
        if v.residuals is None or v.residuals.ndim > 1
        else dataclasses.replace(v, residuals=np.where(np.arange(len(v.residuals)) % 2, 1.0, -1.0))
        for v in pictured.pictures.board_views
    )
    html = render_camera_images(
        dataclasses.replace(pictured, pictures=dataclasses.replace(pictured.pictures, board_views=split)), rig
    )
    assert set(re.findall(r'class="points" style="stroke:(#\w+)"', html)) == {"#d1e5f0", "#fddbc7"}
    assert "2 m in front of the board" in html.replace("2.0 m", "2 m")


def test_without_images_the_boards_are_drawn(pictured: Calibration, rig: Rig) -> None:
    html = render_camera_images(
        dataclasses.replace(pictured, pictures=dataclasses.replace(pictured.pictures, snapshots=())), rig
    )
    assert "enlarged. The images are not part of this result. Coloured dots: " in html
    assert "<img" not in html
    assert 'class="board"' in html


def test_without_points_of_scanners_there_are_no_colours(pictured: Calibration, rig: Rig) -> None:
    corners = tuple(v for v in pictured.pictures.board_views if v.residuals is not None and v.residuals.ndim > 1)
    pictures = dataclasses.replace(pictured.pictures, board_views=corners)
    html = render_camera_images(dataclasses.replace(pictured, pictures=pictures), rig)
    assert "Coloured dots" not in html
    assert 'class="ramp"' not in html


def test_the_number_of_large_images_is_bounded(pictured: Calibration, rig: Rig) -> None:
    assert 2 <= render_camera_images(pictured, rig).count("<img") <= 36


def test_a_rig_without_cameras_has_no_images(network: Calibration, network_rig: Rig) -> None:
    assert render_camera_images(network, network_rig) == ""
    assert render_fused_cloud(network, network_rig) == ""


def test_the_fused_cloud_has_the_colours_of_the_images(pictured: Calibration, rig: Rig) -> None:
    colored = colored_traces(render_fused_cloud(pictured, rig))
    colors = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for t in colored for c in t["marker"]["color"]])
    assert len(colors) > 200
    # JPEG keeps BGR (40, 60, 200) within some steps.
    assert np.abs(colors - [200, 60, 40]).max() < 6


def test_only_points_in_view_of_a_camera_are_coloured(pictured: Calibration, rig: Rig) -> None:
    trace = colored_traces(render_fused_cloud(pictured, rig))[0]
    points = np.array([trace["x"], trace["y"], trace["z"]]).T
    in_view = np.zeros(len(points), dtype=bool)
    for name, camera in calibrated_cameras(pictured, rig).items():
        pixels = camera.project(se3.apply(se3.inverse(pictured[name].T_root_sensor), points))
        # Coordinates are rounded to millimetres on the page.
        in_view |= (np.abs(pixels / [1280, 720] - 0.5) < 0.51).all(axis=1)
    assert in_view.all()


def test_points_of_one_scanner_occlude_those_of_another(pictured: Calibration, rig: Rig) -> None:
    """A point of a 2-D scanner 5 m in front of a camera, behind a board that a LiDAR measures at 2 m."""
    poses = {s.name: s.T_root_sensor for s in pictured.sensors}
    board = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 80), np.linspace(-0.5, 0.5, 80), [2.0]), axis=-1)
    clouds = {"lidar": board.reshape(-1, 3), "laser": np.array([[0.1, 0.05, 5.0]])}
    image = next(s for s in pictured.pictures.snapshots if s.sensor == "camera")
    taken = [
        Snapshot(0, name, 0.0, points=_from_camera(points, poses, name).astype(np.float32))
        for name, points in clouds.items()
    ]
    cloud = _color_points([image, *taken], calibrated_cameras(pictured, rig), poses, np.inf)
    assert cloud["lidar"].colored.all()
    assert not cloud["laser"].colored.any()
    alone = _color_points([image, taken[1]], calibrated_cameras(pictured, rig), poses, np.inf)
    assert alone["laser"].colored.all()


def _from_camera(points: Array, poses: dict[str, Array], name: str) -> Array:
    """Points (N, 3) in the frame of the camera as those of another sensor."""
    return se3.apply(se3.inverse(poses[name]) @ poses["camera"], points)


def test_points_outside_of_images_are_coloured_by_height_or_scanner(pictured: Calibration, rig: Rig) -> None:
    _, lidar, laser, laser_low, _ = data_of(render_fused_cloud(pictured, rig))["data"][:5]
    assert (lidar["name"], laser["name"], laser_low["name"]) == ("lidar", "laser", "laser_low")
    np.testing.assert_allclose(lidar["marker"]["color"], lidar["z"], atol=0.006)
    assert lidar["marker"]["cmin"] < np.median(lidar["z"]) < lidar["marker"]["cmax"]
    assert laser["marker"]["color"] != laser_low["marker"]["color"]


def test_each_button_shows_one_capture(pictured: Calibration, rig: Rig) -> None:
    content = data_of(render_fused_cloud(pictured, rig))
    (choices,) = content["choices"]
    for k, choice in enumerate(choices):
        *clouds, sensors = choice["visible"]
        assert len(clouds) + 1 == len(content["data"])
        # Points in images, those of the LiDAR and of two 2-D scanners, and boards.
        assert np.flatnonzero(clouds).tolist() == list(range(5 * k, 5 * k + 5))
        assert sensors is None


def test_corrected_points_have_buttons_beside_published_ones(pictured: Calibration, rig: Rig) -> None:
    bias = EstimatedParameter("lidar", "range bias", "m", 0.0, 0.02, 0.05, 0.001)
    correction = Correction("lidar3d", (bias,), np.array([[1e-6]]), 2.0)
    html = render_fused_cloud(dataclasses.replace(pictured, corrections={"lidar": correction}), rig)
    labels = re.findall(r"<span>(capture [^<]*)</span>", html)
    half = len(labels) // 2
    assert [f"{label}, corrected" for label in labels[:half]] == labels[half:]
    data = data_of(html)["data"]
    published, corrected = (np.array([data[k][axis] for axis in "xyz"]) for k in (1, 5 * half + 1))
    shorter = np.linalg.norm(np.median(published, axis=1)) - np.linalg.norm(np.median(corrected, axis=1))
    assert shorter == pytest.approx(0.05, abs=0.02)


def test_without_a_correction_there_are_no_buttons_of_it(pictured: Calibration, rig: Rig) -> None:
    assert ", corrected</span>" not in render_fused_cloud(pictured, rig)


def test_an_image_is_shrunk_with_its_aspect_ratio(pictured: Calibration) -> None:
    taken = next(s for s in pictured.pictures.snapshots if s.image)
    assert decoded(render_thumbnail(taken, np.empty((0, 3)))).shape == (90, 160, 3)


def board_pixels(points: Array, board: Array) -> Array:
    """(N, 2) column and row of the orange pixels of a thumbnail, from 0 to 1."""
    image = decoded(render_thumbnail(Snapshot(0, "laser", 0.0, points=points.astype(np.float32)), board))
    rows, columns = np.nonzero((image[..., :3] == (0, 150, 245)).all(axis=-1))
    return np.column_stack([columns / image.shape[1], rows / image.shape[0]])


def test_a_scan_is_drawn_in_top_view_with_its_front_up() -> None:
    """A board 2 m ahead, 1 m to the left, in a room of 4 m to each side."""
    t = np.linspace(-4, 4, 200)
    room = np.concatenate(
        [np.column_stack([x, y, 0 * t]) for x, y in ((t, 4 + 0 * t), (t, -4 + 0 * t), (4 + 0 * t, t))]
    )
    at = board_pixels(room, np.array([[2.0, 1.0, 0.0]])).mean(axis=0)
    assert at[0] < 0.47
    assert at[1] < 0.4


def test_a_cloud_is_drawn_in_azimuth_and_elevation(rng: np.random.Generator) -> None:
    """To the left is 90° of 360°, a quarter from the left edge."""
    sphere = rng.normal(size=(3000, 3))
    at = board_pixels(sphere, np.array([[0.0, 2.0, 1.0]])).mean(axis=0)
    assert at[0] == pytest.approx(0.25, abs=0.02)
    assert at[1] < 0.45


def test_every_capture_has_a_card_with_the_outcome_of_each_sensor(pictured: Calibration) -> None:
    html = render_gallery(pictured)
    assert html.count('<article class="capture">') == 12
    cards = re.findall(r'<article class="capture">.*?</article>', html, re.DOTALL)
    row = next(row for row in pictured.evidence.captures if row.capture == 3 and not row.used)
    assert row.reason in unescape(cards[3])
    assert cards[3].count("<img") == 5


def test_a_result_without_pictures_has_no_gallery(calibration: Calibration) -> None:
    assert render_gallery(calibration) == ""
