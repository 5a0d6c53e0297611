"""Pictures of residuals: what they show of an error that is put in."""

import dataclasses
import json
import re
from typing import Any

import numpy as np

from calgraph.config import Rig
from calgraph.report.residual_view import render_residual_pictures
from calgraph.report.vocabulary import BOARD_VOCABULARY, NETWORK_VOCABULARY
from calgraph.result import BeamView, BoardView, Calibration

PIXEL, RANGE = 0.4, 0.008
"""Noise of the pictured rig, px and m."""

Figures = dict[str, dict[str, Any]]


def drawn(calibration: Calibration, rig: Rig) -> Figures:
    html = render_residual_pictures(calibration, rig, BOARD_VOCABULARY)
    found = re.findall(r'data-for="([^"]+)">(.*?)</script>', html, re.DOTALL)
    return {name: json.loads(data) for name, data in found}


def with_views(pictured: Calibration, views: tuple[BoardView, ...]) -> Calibration:
    return dataclasses.replace(pictured, pictures=dataclasses.replace(pictured.pictures, board_views=views))


def trace(figure: dict[str, Any], name: str) -> dict[str, Any]:
    return next(one for one in figure["data"] if one.get("name") == name)


def test_every_sensor_with_residuals_has_its_figures(pictured: Calibration, rig: Rig) -> None:
    with_residuals = {v.sensor for v in pictured.pictures.board_views}
    counts = {
        k: 4 if s.kind == "camera" else 3 for k, s in enumerate(pictured.sensors) if s.name in with_residuals
    }
    assert set(drawn(pictured, rig)) == {f"errors-{k}-{i}" for k, count in counts.items() for i in range(count)}


def test_a_result_without_residuals_has_no_pictures(calibration: Calibration, rig: Rig) -> None:
    assert render_residual_pictures(calibration, rig, BOARD_VOCABULARY) == ""


def test_the_scatter_of_a_camera_has_its_circle_of_one_sigma(pictured: Calibration, rig: Rig) -> None:
    circle = trace(drawn(pictured, rig)["errors-1-0"], "1 σ")
    np.testing.assert_allclose(np.hypot(circle["x"], circle["y"]), PIXEL, rtol=0.15)


def test_errors_over_the_image_are_enlarged_by_the_stated_factor(pictured: Calibration, rig: Rig) -> None:
    html = render_residual_pictures(pictured, rig, BOARD_VOCABULARY)
    stated = int(re.findall(r"enlarged (\d+) ×", html)[0])
    lines = trace(drawn(pictured, rig)["errors-1-1"], "errors")
    x, y = (np.array(lines[axis], dtype=float).reshape(-1, 3) for axis in "xy")
    lengths = np.hypot(x[:, 1] - x[:, 0], y[:, 1] - y[:, 0])
    # Errors in x and y.
    np.testing.assert_allclose(np.sqrt(np.mean(lengths**2)), stated * np.sqrt(2) * PIXEL, rtol=0.15)


def test_corners_over_the_image_have_the_direction_of_their_error(pictured: Calibration, rig: Rig) -> None:
    def shift(view: BoardView) -> BoardView:
        return dataclasses.replace(view, residuals=np.tile([0.0, 3.0], (len(view.measured), 1)))

    views = tuple(shift(v) if v.sensor == "camera" else v for v in pictured.pictures.board_views)
    dots = drawn(with_views(pictured, views), rig)["errors-1-1"]["data"][-1]["marker"]
    # Image y points down.
    assert set(dots["color"]) == {90.0}
    labels = dict(zip(dots["colorbar"]["tickvals"], dots["colorbar"]["ticktext"], strict=True))
    assert labels[90] == "down"


def test_a_wrong_focal_length_is_a_radial_error(pictured: Calibration, rig: Rig) -> None:
    def stretch(view: BoardView) -> BoardView:
        assert view.residuals is not None
        if view.sensor != "camera":
            return view
        return dataclasses.replace(view, residuals=view.residuals + 0.01 * (view.measured - [639.5, 359.5]))

    wrong = with_views(pictured, tuple(map(stretch, pictured.pictures.board_views)))
    corners = trace(drawn(wrong, rig)["errors-1-2"], "single")
    slope, _ = np.polyfit(corners["x"], corners["y"], 1)
    assert 0.008 < slope < 0.012


def test_corners_that_were_not_used_are_marked(pictured: Calibration, rig: Rig) -> None:
    rejected = tuple(
        dataclasses.replace(view, used=False, residuals=None) if view.capture < 24 else view
        for view in pictured.pictures.board_views
    )
    figure = drawn(with_views(pictured, rejected), rig)["errors-1-1"]
    corners = [view.measured for view in rejected if view.sensor == "camera" and view.residuals is None]
    marks = trace(figure, "not used")
    np.testing.assert_allclose(np.column_stack([marks["x"], marks["y"]]), np.concatenate(corners), rtol=1e-4)
    assert figure["layout"]["showlegend"]


def test_a_range_scale_is_a_slope_over_range(pictured: Calibration, rig: Rig) -> None:
    def lengthen(view: BoardView) -> BoardView:
        assert view.residuals is not None
        if view.sensor != "lidar":
            return view
        return dataclasses.replace(view, residuals=view.residuals + 0.01 * np.linalg.norm(view.measured, axis=1))

    wrong = with_views(pictured, tuple(map(lengthen, pictured.pictures.board_views)))
    mean = trace(drawn(wrong, rig)["errors-0-0"], "mean")
    slope, _ = np.polyfit(mean["x"], mean["y"], 1)
    assert 8 < slope < 12  # mm per m
    right = trace(drawn(pictured, rig)["errors-0-0"], "mean")
    assert abs(np.polyfit(right["x"], right["y"], 1)[0]) < 2


def test_a_step_over_time_is_drawn_per_capture(pictured: Calibration, rig: Rig) -> None:
    def shift(view: BoardView) -> BoardView:
        if view.sensor != "lidar" or view.capture < 24 or view.residuals is None:
            return view
        return dataclasses.replace(view, residuals=view.residuals + 0.02)

    figure = drawn(with_views(pictured, tuple(map(shift, pictured.pictures.board_views))), rig)["errors-0-2"]
    mean = trace(figure, "mean")
    late = np.array(mean["x"]) > 6 + 3.4 * 24
    y = np.array(mean["y"])
    assert len(y) == 48
    np.testing.assert_allclose([y[~late].mean(), y[late].mean()], [0, 20], atol=1)
    assert np.mean(trace(figure, "RMS")["y"]) > 1e3 * RANGE


def test_lines_over_time_stop_at_gaps(pictured: Calibration, rig: Rig) -> None:
    views = tuple(view for view in pictured.pictures.board_views if not 10 <= view.capture < 40)
    over_time = trace(drawn(with_views(pictured, views), rig)["errors-0-2"], "RMS")
    assert over_time["x"].count(None) == over_time["y"].count(None) == 1


def test_a_network_has_its_ranges_over_time_in_bins(network: Calibration, network_rig: Rig) -> None:
    rng = np.random.default_rng(0)
    times, points = np.linspace(0, 60, 2000), rng.uniform(2, 8, (2000, 2))
    beams = BeamView("door <b>", times, points, rng.normal(0, 0.01, 2000))
    shown = dataclasses.replace(network, pictures=dataclasses.replace(network.pictures, beam_views=(beams,)))
    html = render_residual_pictures(shown, network_rig, NETWORK_VOCABULARY)
    assert "<h3>door &lt;b&gt;</h3>" in html
    figures = {n: json.loads(d) for n, d in re.findall(r'data-for="([^"]+)">(.*?)</script>', html, re.DOTALL)}
    over_time = trace(figures["errors-1-2"], "RMS")
    assert len(over_time["x"]) == 40
    np.testing.assert_allclose(over_time["y"], 10, rtol=0.6)


def test_many_sensors_are_collapsed_and_bounded(network: Calibration, network_rig: Rig) -> None:
    rng = np.random.default_rng(0)
    scanners = tuple(
        dataclasses.replace(network.sensors[1], name=f"scanner_{k}", parent="hall") for k in range(60)
    )
    beams = tuple(
        BeamView(one.name, np.linspace(0, 60, 900), rng.uniform(2, 8, (900, 2)), rng.normal(0, 0.01, 900))
        for one in scanners
    )
    large = dataclasses.replace(
        network,
        sensors=(network.sensors[0], *scanners),
        joint_covariance=np.zeros((6 * 61, 6 * 61)),
        pictures=dataclasses.replace(network.pictures, beam_views=beams),
    )
    html = render_residual_pictures(large, network_rig, NETWORK_VOCABULARY)
    assert html.count("<details>") == 60
    figures = {n: json.loads(d) for n, d in re.findall(r'data-for="([^"]+)">(.*?)</script>', html, re.DOTALL)}
    assert len(figures) == 180
    assert max(len(one["data"][0]["x"]) for one in figures.values()) < 24_000 / 60
    # Means are of all residuals.
    assert sum(one["x"] is not None for one in figures["errors-1-0"]["data"]) >= 3
    assert len(html) < 6_000_000
