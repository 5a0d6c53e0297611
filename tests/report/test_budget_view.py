"""The bars of what the uncertainty comes from."""

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from calgraph.report.budget_view import render_budget
from calgraph.result import Calibration, ErrorBudget, ErrorSource, SensorPose, Verdict, join_covariances

SOURCES = (
    ErrorSource("noise", "lidar"), ErrorSource("range <bias>", "lidar"), ErrorSource("noise", "laser"),
    ErrorSource("bow", "board"), ErrorSource("drift"),
)  # fmt: skip
SHARES = np.array([0.16, 0.6, 0.225, 0.009, 0.006])


def with_budget(scanners: int) -> Calibration:
    """Scanners whose heights and yaws are known worst, with these shares; the later, the less certain."""
    root = SensorPose("lidar", None, "lidar", "lidar3d", np.eye(4), Verdict("good"))
    others = [
        SensorPose(f"laser_{k}", "lidar", "", "lidar2d", np.eye(4), Verdict("good")) for k in range(scanners)
    ]
    sigma = np.array([1e-3, 1e-3, 2e-3, 1e-3, 1e-3, 4e-3])
    stddev = np.zeros((len(SOURCES), 1 + scanners, 6))
    stddev[:, 1:] = np.sqrt(SHARES)[:, None, None] * sigma * np.arange(1, scanners + 1)[:, None]
    covariances = [np.diag((stddev[:, k] ** 2).sum(axis=0)) for k in range(1 + scanners)]
    return Calibration(
        "lidar", (root, *others), join_covariances(covariances), budget=ErrorBudget(SOURCES, stddev)
    )


def traces(calibration: Calibration) -> dict[str, dict[str, Any]]:
    """The bars of the figure by what the legend says."""
    found = re.search(r'data-for="budget-shares">(.*?)</script>', render_budget(calibration))
    assert found
    return {trace["name"]: trace for trace in json.loads(found[1])["data"]}


def test_the_largest_source_comes_first_and_the_bar_is_whole() -> None:
    segments = sorted(
        (start, share, kind)
        for kind, one in traces(with_budget(1)).items()
        for bar, start, share in zip(one["y"], one["base"], one["x"], strict=True)
        if "height (z)" in bar
    )
    kinds = ["range &lt;bias&gt;", "noise", "noise", "others"]
    assert [kind for _, _, kind in segments] == kinds
    np.testing.assert_allclose([share for _, share, _ in segments], [60, 22.5, 16, 1.5], rtol=1e-5)
    np.testing.assert_allclose([start for start, _, _ in segments], [0, 60, 82.5, 98.5], rtol=1e-5)


def test_a_bar_is_of_the_worst_axis_with_its_deviation() -> None:
    bars = list(dict.fromkeys(traces(with_budget(1))["noise"]["y"]))
    assert bars == ["<b>laser_0</b><br>height (z), σ 2.0 mm", "<b>laser_0</b><br>yaw (about z), σ 0.23°"]


def test_hovering_names_the_source_its_deviation_its_share_and_a_remedy() -> None:
    bias = traces(with_budget(1))["range &lt;bias&gt;"]
    # 2 mm times the root of 0.6; 0.23° likewise.
    remedy = "<br>smaller by measuring it, and stating its uncertainty in rig.yaml"
    assert bias["customdata"] == [
        f"range &lt;bias&gt; of lidar<br>σ 1.5 mm, 60 % of the variance{remedy}",
        f"range &lt;bias&gt; of lidar<br>σ 0.18°, 60 % of the variance{remedy}",
    ]
    assert traces(with_budget(1))["others"]["customdata"][0].startswith("2 other sources<br>σ 0.24 mm, 1.5 %")


def test_only_large_shares_are_labelled() -> None:
    labels = [text for trace in traces(with_budget(1)).values() for text in trace["text"] if text]
    assert labels == ["range &lt;bias&gt; of lidar"] * 2 + ["noise of laser", "noise of lidar"] * 2


def test_a_kind_has_one_colour_in_all_bars() -> None:
    colors = [trace["marker"]["color"] for trace in traces(with_budget(3)).values()]
    assert len(set(colors)) == len(colors) == 3
    assert len(traces(with_budget(3))["noise"]["x"]) == 2 * 3 * 2


def test_of_many_sensors_the_least_certain_are_shown() -> None:
    calibration = with_budget(24)
    assert "The 20 least certain of 24 sensors are shown" in render_budget(calibration)
    bars = {bar.partition("<br>")[0] for bar in traces(calibration)["noise"]["y"]}
    assert bars == {f"<b>laser_{k}</b>" for k in range(4, 24)}


@pytest.mark.parametrize("scanners", [0, 1])
def test_without_a_budget_or_sensors_there_is_no_figure(scanners: int) -> None:
    calibration = with_budget(scanners)
    assert render_budget(calibration if scanners == 0 else replace(calibration, budget=None)) == ""
