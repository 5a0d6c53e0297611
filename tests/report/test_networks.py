"""The page of a network: floor plan, walks, and captions."""

import dataclasses
import json
import re
from html import unescape
from typing import Any

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.geometry import Array
from calgraph.report.page import render_report
from calgraph.result import Calibration, CaptureRow, FloorView, ModelledBodies


def without_scripts(html: str) -> str:
    return re.sub(r"<(script|style).*?</\1>", " ", html, flags=re.DOTALL)


def words_of(html: str) -> str:
    return " ".join(re.sub(r"<[^>]*>", " ", without_scripts(html)).split())


def figure_of(html: str, name: str) -> dict[str, Any]:
    (data,) = re.findall(rf'<script type="application/json"[^>]*data-for="{name}">(.*?)</script>', html)
    figure: dict[str, Any] = json.loads(data)
    return figure


def lines_of(figure: dict[str, Any], scanner: str) -> list[Array]:
    """(N, 2) points of all lines of one scanner; tracks first, if there are any."""
    return [
        np.array([trace["x"], trace["y"]], dtype=np.float64).T
        for trace in figure["data"]
        if trace["legendgroup"] == scanner and trace["mode"] == "lines"
    ]


@pytest.fixture
def html(network: Calibration, network_rig: Rig) -> str:
    return render_report(network, network_rig)


def test_there_is_no_text_on_boards_and_captures(html: str) -> None:
    text = re.sub(r'(id|for|class|href|data-for)="[^"]*"', "", without_scripts(html)).lower()
    assert "board" not in text
    assert "capture" not in text
    assert "tilt" not in text


def test_facts_and_edges_count_walks_and_positions(html: str) -> None:
    words = words_of(html)
    assert "root hall · 3 walks · estimator averaging" in words
    assert "300 of 340 · RMS 4.0 mm" in words
    assert "door &lt;b&gt; – stairs 50 0 – inconsistent with the other pairs" in words


def test_what_people_are_taken_for_is_stated(network: Calibration, network_rig: Rig) -> None:
    evidence = dataclasses.replace(network.evidence, estimator="joint", bodies=ModelledBodies("legs", 24))
    html = render_report(dataclasses.replace(network, evidence=evidence), network_rig)
    assert "estimator joint · targets: legs (24 tracked)" in words_of(html)


def test_sensors_without_a_reason_get_advice_on_walking(html: str) -> None:
    words = words_of(html)
    assert "Let people walk longer paths in several directions" in words
    assert "Let people walk longer where its view and that of another scanner with a pose overlap." in words


def test_poses_are_those_in_the_plane(html: str) -> None:
    assert "6.0000 ± 10 mm 1.0000 ± 20 mm 114.592° z 0.057°" in words_of(html)
    assert "roll" not in words_of(html)


def test_walls_and_walks_are_at_their_positions(html: str, network: Calibration) -> None:
    floor = figure_of(html, "floor")
    points = next(t for t in floor["data"] if t["legendgroup"] == "hall" and t["mode"] == "markers")
    np.testing.assert_allclose(
        np.array([points["x"], points["y"]]).T, network.pictures.floor_views[0].background, atol=1e-5
    )
    walked = lines_of(floor, "hall")[0]
    np.testing.assert_allclose(
        walked[np.isfinite(walked[:, 0])], np.concatenate(network.pictures.floor_views[0].tracks), atol=1e-5
    )


def test_walks_are_not_joined(html: str) -> None:
    walked = lines_of(figure_of(html, "floor"), "hall")[0]
    assert np.isnan(walked[41]).all()


def test_ellipses_contain_95_percent_times_the_stated_factor(html: str) -> None:
    (factor,) = re.findall(r"with 95 % probability; drawn (\d+) × enlarged", words_of(html))
    ellipse = lines_of(figure_of(html, "floor"), "stairs")[0]
    half_axes = np.ptp(ellipse, axis=0) / 2
    np.testing.assert_allclose(half_axes, 2.4477 * int(factor) * np.array([0.01, 0.02]), rtol=0.01)
    # On a plan of some 8 m it is visible, and does not cover its neighbours.
    assert 0.05 < half_axes.max() < 0.5


def test_visible_ellipses_are_to_scale(network: Calibration, network_rig: Rig) -> None:
    uncertain = dataclasses.replace(network, joint_covariance=100 * network.joint_covariance)
    html = render_report(uncertain, network_rig)
    assert "the sensor's position with 95 % probability; drawn to scale." in unescape(words_of(html))


def test_the_root_has_no_ellipse(html: str) -> None:
    walked, *others = lines_of(figure_of(html, "floor"), "hall")
    assert len(walked) > 5
    assert [len(line) for line in others] == [5]


def test_arrows_point_along_x(html: str) -> None:
    arrow = lines_of(figure_of(html, "floor"), "stairs")[-1]
    along = arrow[1] - arrow[0]
    assert np.arctan2(along[1], along[0]) == pytest.approx(-1.5, abs=1e-4)


def test_every_scanner_is_in_the_legend_once(html: str) -> None:
    entries = [t["name"] for t in figure_of(html, "floor")["data"] if t.get("showlegend", True)]
    assert entries == ["hall", "door &lt;b&gt;", "stairs"]


def test_walks_are_drawn_at_their_times(html: str) -> None:
    used, unused = figure_of(html, "captures")["data"]
    assert used["x"] == [0, 4, None, 0.5, 4.5, None]
    assert unused["x"] == [2, 3, None]
    assert unused["text"][0].endswith("2.0 – 3.0 s<br>no other sensor detected a person at that time")


def test_simultaneous_walks_have_separate_lanes(html: str) -> None:
    used, unused = figure_of(html, "captures")["data"]
    assert 0.1 < abs(used["y"][0] - unused["y"][0]) < 0.5


def test_a_result_without_a_floor_still_has_its_scanners(network: Calibration, network_rig: Rig) -> None:
    html = render_report(
        dataclasses.replace(
            network,
            evidence=dataclasses.replace(network.evidence, captures=()),
            pictures=dataclasses.replace(network.pictures, floor_views=()),
        ),
        network_rig,
    )
    assert len([t for t in figure_of(html, "floor")["data"] if "text" in t]) == 3
    assert "There are no walks" in words_of(html)


def test_unknown_covariances_have_no_ellipse(network: Calibration, network_rig: Rig) -> None:
    unknown = np.full_like(network.joint_covariance, np.nan)
    html = render_report(
        dataclasses.replace(
            network, joint_covariance=unknown, pictures=dataclasses.replace(network.pictures, floor_views=())
        ),
        network_rig,
    )
    assert all(len(line) == 5 for line in lines_of(figure_of(html, "floor"), "stairs"))


def test_a_large_network_stays_below_10_mb(network: Calibration, network_rig: Rig) -> None:
    """Thirty scanners with as much on the floor as results hold, and twenty thousand walks."""
    rng = np.random.default_rng(0)
    floor = tuple(
        FloorView(f"s{k}", rng.normal(size=(400, 2)), tuple(rng.normal(size=(50, 20, 2)))) for k in range(30)
    )
    sensors = (
        network.sensors[0],
        *(dataclasses.replace(network.sensors[1], name=f"s{k}", parent="hall") for k in range(29)),
    )
    reason = "other sensors detected people at that time, but not within 0.5 m of it"
    rows = tuple(CaptureRow(n, n / 7, n / 7 + 5, f"s{n % 29}", n % 2 == 0, reason) for n in range(20_000))
    large = dataclasses.replace(
        network,
        sensors=sensors,
        joint_covariance=np.zeros((180, 180)),
        evidence=dataclasses.replace(network.evidence, captures=rows),
        pictures=dataclasses.replace(network.pictures, floor_views=floor),
    )
    html = render_report(large, network_rig)
    assert len(html.encode()) < 10e6
    assert "5000 of 20000 rows are shown; captures.csv has all." in words_of(html)


def test_boxes_of_many_sensors_do_not_overlap(network: Calibration, network_rig: Rig) -> None:
    """Each of thirty boxes shows at least two thirds of its width or half of its height beside any other."""
    door = network.sensors[1]
    others = (dataclasses.replace(door, name=f"s{k}", parent=f"s{k - 1}" if k else "hall") for k in range(29))
    html = render_report(
        dataclasses.replace(
            network,
            sensors=(network.sensors[0], *others),
            joint_covariance=np.zeros((180, 180)),
            evidence=dataclasses.replace(network.evidence, edges=()),
        ),
        network_rig,
    )
    found = re.findall(r'<g class="node [^"]*"><title>[^<]*</title><rect x="([\d.]+)" y="([\d.]+)"', html)
    corners = np.array(found, dtype=np.float64)[:30]
    apart = np.abs(corners[:, None] - corners) / [150, 44]
    clear = (apart[..., 0] > 2 / 3) | (apart[..., 1] > 1 / 2) | np.eye(30, dtype=bool)
    assert clear.all()
