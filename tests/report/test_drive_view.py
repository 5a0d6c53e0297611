"""The report of a drive: plan before and after, surfaces by axis, residuals by incidence, motion and clocks."""

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from plotly.offline import get_plotlyjs

from calgraph.geometry import se3, so3
from calgraph.report.coverage_view import compute_coverage
from calgraph.report.page import render_report
from calgraph.result import Calibration, DrivePath, DriveView, Pictures
from driven_results import LATE, OFF, driven, driven_rig

WORDS = re.compile(r"<[^>]+>")


def page_of(calibration: Calibration, *, planar: bool = False) -> str:
    return render_report(calibration, driven_rig(planar=planar)).replace(get_plotlyjs(), "")


def figure(page: str, name: str) -> dict[str, Any]:
    found = re.search(
        rf'<script type="application/json" class="figure-data" data-for="{name}">(.*?)</script>', page
    )
    assert found is not None
    content: dict[str, Any] = json.loads(found[1])
    return content


def cells(page: str, head: str) -> list[str]:
    """Of the row of the second scanner in the table with a head."""
    table = page[page.index(head) :]
    row = table[table.index('<th scope="row">rear</th>') :]
    return [WORDS.sub("", one) for one in re.findall(r"<td.*?>(.*?)</td>", row[: row.index("</tr>")])]


@pytest.fixture(scope="module")
def page() -> str:
    return page_of(driven())


def traces_of(page: str, name: str) -> list[dict[str, Any]]:
    return [trace for trace in figure(page, "drive-plan")["data"] if trace.get("name") == name]


def test_the_start_displaces_the_map(page: str) -> None:
    before, after = traces_of(page, "rear")
    x, y = (np.array(after[axis]) - np.array(before[axis]) for axis in "xy")
    np.testing.assert_allclose(y, -OFF, atol=2e-3)
    # The clock of the start is early: its points are placed where the robot is later.
    np.testing.assert_allclose(x, -LATE, atol=2e-3)
    sides = np.abs(np.array(after["y"]))
    assert np.sum(np.abs(sides - 3) < 2e-3) == 120


def test_buttons_select_the_poses(page: str) -> None:
    content = figure(page, "drive-plan")
    names = [trace.get("name") for trace in content["data"]]
    ((before, after),) = content["choices"]
    shown = [[k for k, on in enumerate(one["visible"]) if on is not False] for one in (before, after)]
    assert [[names[k] for k in of] for of in shown] == [["front", "rear", "trajectory", None]] * 2
    assert shown[0] != shown[1]


def test_distances_are_those_of_points_on_common_surfaces(page: str) -> None:
    """Of 200 points 120 are on walls that the start displaces by 100 mm; their residuals are 1 mm."""
    assert cells(page, "distance before") == ["walls", "60 %", "100 mm", "1.0 mm"]
    floor = page[page.index("distance before") :]
    assert cells(floor[floor.index("</tr>", floor.index("1.0 mm")) :], "") == [
        "floors and ceilings", "20 %", "1.0 mm", "1.0 mm",
    ]  # fmt: skip


def test_each_axis_has_its_surfaces(page: str) -> None:
    bars = {trace["name"]: trace for trace in figure(page, "drive-supports")["data"]}
    assert set(bars) == {"walls beside", "floors and ceilings"}
    sensors, axes = bars["walls beside"]["y"]
    assert set(sensors) == {"rear"}
    shares = {kind: dict(zip(axes, bar["x"], strict=True)) for kind, bar in bars.items()}
    # No common wall is ahead or behind: nothing determines x.
    assert axes == ["y", "z", "about x", "about y", "about z"]
    assert shares["walls beside"]["y"] == shares["walls beside"]["about z"] == pytest.approx(100)
    assert shares["floors and ceilings"]["z"] == shares["floors and ceilings"]["about y"] == pytest.approx(100)
    assert 0 < shares["floors and ceilings"]["about x"] < 100


def test_walls_ahead_are_told_apart_by_the_motion() -> None:
    found = driven(planar=True)
    views = tuple(replace(view, shared=np.ones_like(view.shared)) for view in found.pictures.drive_views)
    page = page_of(replace(found, pictures=replace(found.pictures, drive_views=views)), planar=True)
    bars = {trace["name"]: trace for trace in figure(page, "drive-supports")["data"]}
    assert set(bars) == {"walls beside", "walls ahead or behind"}
    assert bars["walls ahead or behind"]["y"][1] == ["x", "y", "about z"]
    np.testing.assert_allclose(bars["walls ahead or behind"]["x"][:2], [100, 0], atol=1e-6)


def test_clocks_have_values_before_and_after(page: str) -> None:
    assert cells(page, "clock offset by turn rates") == ["30.00 ms", "50.00 ms", "0.10 ms"]


def test_the_motion_is_that_of_the_path() -> None:
    """Turning by 0.4 rad/s while it drives."""
    found = driven()
    (path,) = found.pictures.drive_paths
    turn = so3.exp(0.4 * path.times[:, None] * np.array([0.0, 0, 1]))
    turning = DrivePath(path.times, se3.pose(turn, path.T_world_root[:, :3, 3]))
    page = page_of(replace(found, pictures=replace(found.pictures, drive_paths=(turning,))))
    lines = {
        trace["name"]: np.array(trace["y"][:-1], dtype=float) for trace in figure(page, "drive-motion")["data"]
    }
    assert set(lines) == {"speed", "turn rate"}
    np.testing.assert_allclose(lines["speed"], 1.0, atol=1e-3)
    np.testing.assert_allclose(lines["turn rate"], np.degrees(0.4), atol=1e-2)


def test_residuals_are_shown_over_range_and_incidence(page: str) -> None:
    assert page.count("<h4>Over incidence</h4>") == 2
    assert page.count("<h4>Over range</h4>") == 2
    assert "There are no residuals" not in page
    assert page.count("residual 1.0 mm RMS, 1.5 mm by the median") == 2
    # Those on the left wall are between 3 and 4 m away, at most 45° or so to its normal.
    angles = figure(page, "errors-0-2")["data"][0]["x"]
    assert 0 <= min(angles) <= max(angles) <= 90


def test_sections_of_captures_are_left_out(page: str) -> None:
    assert 'id="drive"' in page
    assert 'id="captures-section"' not in page
    assert "10 seconds" in page


def test_coverage_is_that_of_common_surfaces() -> None:
    calibration, rig = driven(planar=True), driven_rig(planar=True)
    found = compute_coverage(calibration, rig, calibration["front"])
    assert found is not None
    assert "Common surfaces were in" in found.remarks[0]
    # Ahead there is a wall, but the other scanner did not measure it.
    assert "(ahead)" in found.remarks[0]
    assert found.counts.max() <= 10


def test_parts_have_buttons() -> None:
    found = driven()
    (path,) = found.pictures.drive_paths
    later = DrivePath(path.times + 20, path.T_world_root)
    views = [
        *found.pictures.drive_views,
        *(replace(view, part=1, times=view.times + 20) for view in found.pictures.drive_views),
    ]
    page = page_of(
        replace(found, pictures=replace(found.pictures, drive_views=tuple(views), drive_paths=(path, later)))
    )
    content = figure(page, "drive-plan")
    parts, _ = content["choices"]
    assert [sum(one["visible"]) for one in parts] == [len(content["data"]) / 2] * 2
    assert "20 to 30 s" in page
    assert "Each part of the drive has a separate world" in page


def test_a_drive_without_a_solution_has_the_section_of_captures() -> None:
    page = page_of(replace(driven(), pictures=Pictures()))
    assert 'id="drive"' not in page
    assert "there are no captures" in page
    assert "0 seconds" not in page


@pytest.mark.parametrize(
    ("reason", "advised"),
    [("the robot hardly turned: drive curves", False), ("it has 10 sweeps with points; a drive needs 50", True)],
)
def test_what_to_drive_is_stated_once(reason: str, advised: bool) -> None:
    found = driven()
    evidence = replace(found.evidence, unconnected={"rear": reason})
    page = page_of(replace(found, sensors=found.sensors[:1], joint_covariance=np.zeros((6, 6)), evidence=evidence))
    assert reason[0].upper() + reason[1:] + "." in page
    assert ("Check its topic, and drive" in page) == advised


def test_the_page_is_small() -> None:
    """Six parts with as many points as are kept of four scanners: but for plotly less than 2 MB."""
    found, rng = driven(), np.random.default_rng(0)
    (path,) = found.pictures.drive_paths

    def view(sensor: str, part: int) -> DriveView:
        count = 670
        normals = np.tile(np.array([0.0, 1, 0], np.float32), (count, 1))
        return DriveView(
            sensor, part, rng.uniform(0, 10, count), rng.normal(0, 9, (count, 3)).astype(np.float32), normals,
            rng.normal(0, 0.01, count), np.ones(count, dtype=np.bool_),
        )  # fmt: skip

    views = tuple(view(name, part) for part in range(6) for name in ("front", "rear") * 2)
    page = page_of(replace(found, pictures=replace(found.pictures, drive_views=views, drive_paths=(path,) * 6)))
    assert len(page) < 2e6
