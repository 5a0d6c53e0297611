"""The page of a network in space: plan and 3-D view are level though the root is not, and words are of sensors."""

import json
import re
from typing import Any

import numpy as np
import pytest

from calgraph.geometry import Array, se3
from calgraph.report.coverage_view import compute_coverage
from calgraph.report.page import render_report
from space_results import BEFORE, STDDEV, T_PLAN_OTHER, T_PLAN_ROOT, WALK, WALL, hall, hall_rig


@pytest.fixture(scope="module")
def html() -> str:
    return render_report(hall(), hall_rig())


def figure_of(html: str, name: str) -> dict[str, Any]:
    (data,) = re.findall(rf'<script type="application/json"[^>]*data-for="{name}">(.*?)</script>', html)
    figure: dict[str, Any] = json.loads(data)
    return figure


def points_of(trace: dict[str, Any]) -> Array:
    """(N, 2) or (N, 3) of a trace, without breaks."""
    points = np.array([trace[axis] for axis in "xyz" if axis in trace], dtype=np.float64).T
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def test_the_plan_has_sensors_where_they_are_in_the_hall(html: str) -> None:
    named = {t["name"]: t for t in figure_of(html, "floor")["data"] if t.get("mode") == "markers+text"}
    np.testing.assert_allclose(points_of(named["root"]), [[0, 0]], atol=1e-6)
    np.testing.assert_allclose(points_of(named["other"]), [T_PLAN_OTHER[:2, 3]], atol=1e-5)


def test_walls_and_walks_stay_and_arrows_and_ellipses_are_levelled(html: str) -> None:
    wall, walk, ellipse, arrow, _ = (
        points_of(t) for t in figure_of(html, "floor")["data"] if t["legendgroup"] == "other"
    )
    np.testing.assert_allclose(wall, WALL, atol=1e-5)
    np.testing.assert_allclose(walk, WALK, atol=1e-5)
    (factor,) = re.findall(r"with 95 % probability; drawn (\d+) × enlarged", html)
    np.testing.assert_allclose(np.ptp(ellipse, axis=0) / 2, 2.4477 * int(factor) * STDDEV[:2], rtol=0.01)
    along = arrow[1] - arrow[0]
    assert np.arctan2(along[1], along[0]) == pytest.approx(np.arctan2(*T_PLAN_OTHER[1::-1, 0]), abs=1e-4)


def test_the_plan_before_the_joint_solution_is_moved_in_the_plane(html: str) -> None:
    (states,) = figure_of(html, "floor")["choices"]
    identity, before, _ = (state.get("moves") for state in states)
    np.testing.assert_allclose(before[0], [1, 0, 0, 0], atol=1e-6)
    c, s, x, y = before[1]
    moved = WALK @ np.array([[c, s], [-s, c]]) + [x, y]
    np.testing.assert_allclose(moved, se3.apply(BEFORE, np.pad(WALK, ((0, 0), (0, 1))))[:, :2], atol=1e-4)
    # Without poses, the sensor is where the root is, with its x axis along that of the plan.
    c, s, x, y = identity[1]
    np.testing.assert_allclose(np.array([[c, -s], [s, c]]) @ T_PLAN_OTHER[:2, 3] + [x, y], 0, atol=1e-4)


def test_the_view_in_space_is_level_and_without_the_ceiling(html: str) -> None:
    figure = figure_of(html, "rig")
    static = {t["name"]: points_of(t) for t in figure["data"] if t.get("mode") == "markers"}
    assert set(static) == {"root", "other"}
    for points in static.values():
        assert len(points) == 400
        assert np.sum(np.abs(points[:, 2]) < 0.01) >= 200
        assert points[:, 2].max() < 3
    walks = [points_of(t) for t in figure["data"] if t["name"] == "walks"]
    np.testing.assert_allclose(walks[0], np.pad(WALK, ((0, 0), (0, 1))), atol=1e-5)
    (names,) = (points_of(t) for t in figure["data"] if t.get("mode") == "markers+text")
    np.testing.assert_allclose(names, [T_PLAN_ROOT[:3, 3], T_PLAN_OTHER[:3, 3]], atol=1e-5)
    alone, everything = figure["choices"][0]
    hidden = [t["name"] for t, shown in zip(figure["data"], alone["visible"], strict=False) if not shown]
    assert set(hidden) == {"root", "other", "walks"}
    assert all(everything["visible"])


def test_words_are_of_sensors_and_walks(html: str) -> None:
    text = re.sub(r"<(script|style).*?</\1>", " ", html, flags=re.DOTALL)
    text = re.sub(r'(id|for|class|href|data-for)="[^"]*"', "", text).lower()
    for word in ("board", "capture", "2-d", "scan plane", "beams on people"):
        assert word not in text, word
    assert "<h2>floor plan</h2>" in text
    assert "<h2>3-d view</h2>" in text
    assert "a line is one track of one sensor" in text


def test_coverage_is_by_elevation_in_the_frame_of_the_sensor() -> None:
    calibration = hall()
    middle = np.column_stack([WALK, np.full(len(WALK), 0.9)])
    own = se3.apply(se3.inverse(T_PLAN_OTHER), middle)
    elevation = np.degrees(np.arctan2(own[:, 2], np.hypot(own[:, 0], own[:, 1])))
    found = compute_coverage(calibration, hall_rig(), calibration["other"])
    assert found is not None
    assert found.axes == ("azimuth, °", "elevation, °")
    rows = np.flatnonzero(found.counts.any(axis=1))
    assert found.y_edges[rows[0]] >= elevation.max() >= found.y_edges[rows[0] + 1]
    assert found.y_edges[rows[-1]] >= elevation.min() >= found.y_edges[rows[-1] + 1]
    assert any(text.startswith("People walked in ") for text in found.remarks)
