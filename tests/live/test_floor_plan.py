"""The floor plan on the phone: names, sizes, and where people should walk."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

from calgraph.config import Tolerance
from calgraph.geometry import se2
from calgraph.live.floor_grid import FloorGrid
from calgraph.live.floor_plan import draw_floor_plan
from calgraph.live.network_solution import LiveNetworkSolution
from calgraph.live.sensor_solution import SensorSolution

SVG = "{http://www.w3.org/2000/svg}"


def grid(width: int = 20, height: int = 10) -> FloorGrid:
    cells = np.zeros((width, height), dtype=np.bool_)
    walked = cells.copy()
    walked[2:5, 3] = True
    return FloorGrid(np.array([-1.0, -1.0]), 0.5, walked, cells, np.array([[0.0, 0.0], [2.0, 1.0]]))


def scanner(
    name: str, x: float = 0.0, y: float = 0.0, sigma: float = 0.004, grade: str = "good"
) -> SensorSolution:
    return SensorSolution(
        name,
        "lidar2d",
        se2.to_se3(se2.pose(0.5, np.array([x, y]))),
        np.array([sigma, sigma / 2, 0, 0, 0, 0.001]),
        np.diag([sigma, sigma / 2, 0]) ** 2,
        0.8,
        grade,
        clock_offset=-0.012,
    )


def solution(*scanners: SensorSolution) -> LiveNetworkSolution:
    return LiveNetworkSolution(scanners, grid(), 0.0, 60.0, 60.0, 60.0)


def draw(found: LiveNetworkSolution, root: str = "root") -> ET.Element:
    text = draw_floor_plan(found, root, Tolerance(translation=0.01, rotation=0.3))
    assert len(text) <= 60_000
    return ET.fromstring(text)


def texts(drawn: ET.Element) -> list[str]:
    return ["".join(element.itertext()) for element in drawn.iter(f"{SVG}text")]


def test_scanners_are_named_in_the_plan_and_listed_with_their_errors() -> None:
    shown = texts(draw(solution(scanner("root"), scanner("laser", 2.0))))
    assert shown.count("laser") == 2
    # 1.96 standard deviations of 4 mm and 1 mrad.
    assert "±7.8 mm ±0.1° (95 %) · clock \N{MINUS SIGN}12 ms" in shown
    assert "origin of the plan" in shown


def test_scanners_without_a_pose_are_listed_first_with_what_is_missing() -> None:
    apart = [SensorSolution("blind", "lidar2d"), SensorSolution("alone", "lidar2d", tracks=4)]
    shown = texts(draw(solution(scanner("root"), *apart, scanner("laser", 2.0))))
    assert shown[-8:-4] == ["blind", "alone", "root", "laser"]
    assert shown[-4:-2] == ["no person detected", "not calibrated"]


def test_names_are_text_and_no_markup() -> None:
    name = '<script>"&\x07'
    shown = texts(draw(solution(scanner("root"), scanner(name, 2.0))))
    assert shown.count('<script>"& ') == 2


def test_long_names_are_shortened() -> None:
    shown = texts(draw(solution(scanner("root"), scanner("laser_at_the_end_of_the_corridor", 2.0))))
    assert shown.count("laser_at_the_end_…") == 2


def test_an_error_is_drawn_at_the_scale_of_the_tolerance() -> None:
    drawn = draw(solution(scanner("root"), scanner("laser", 2.0, sigma=0.01 / 1.96, grade="weak")))
    ellipse = list(drawn.iter(f"{SVG}ellipse"))[-1]
    circle = next(one for one in drawn.iter(f"{SVG}circle") if one.get("r") == "11")
    assert float(ellipse.get("rx", "")) == float(circle.get("r", ""))
    assert float(ellipse.get("ry", "")) == pytest.approx(float(circle.get("r", "")) / 2)


def test_scanners_are_where_their_poses_are() -> None:
    drawn = draw(solution(scanner("root"), scanner("laser", 4.0, 2.0)))
    root, laser = (
        np.array(arrow.get("transform", "").partition(")")[0][10:].split(), dtype=float)
        for arrow in drawn.findall(f"{SVG}g/{SVG}path")
    )
    step = laser - root
    # The y axis of images points down.
    assert step[0] / 4 == pytest.approx(-step[1] / 2, rel=0.01)
    assert step[0] > 100


def test_names_do_not_cover_each_other() -> None:
    close = [scanner("root"), *(scanner(f"laser_{k}", 1.0 + k) for k in range(4))]
    drawn = draw(solution(*close))
    names = [one for one in drawn.findall(f"{SVG}g/{SVG}text") if one.get("textLength")]
    assert len(names) == 5
    boxes = [(float(one.get("x", "")), float(one.get("y", "")), float(one.get("textLength", ""))) for one in names]
    for k, (x, y, width) in enumerate(boxes):
        assert 0 <= x <= 360 - width
        assert all(abs(y - v) >= 13 or x + width <= u or u + w <= x for u, v, w in boxes[:k])


def test_a_network_of_many_scanners_in_a_large_hall_fits() -> None:
    rng = np.random.default_rng(0)
    noise = rng.random((80, 80)) < 0.5
    hall = FloorGrid(np.zeros(2), 1.0, noise, ~noise, rng.uniform(0, 80, (1400, 2)))
    scanners = [scanner(f"scanner_{k}", *rng.uniform(0, 80, 2)) for k in range(40)]
    draw(replace(solution(*scanners), grid=hall))


def test_without_connected_scanners_there_is_the_list() -> None:
    found = replace(solution(SensorSolution("root", "lidar2d"), SensorSolution("laser", "lidar2d")), grid=None)
    assert texts(draw(found)) == ["root", "laser", "no person detected", "no person detected"]
