"""The picture of the next board pose: its words, its size, and names of sensors as text."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from calgraph.geometry import Array, se3, so3
from calgraph.report.pose_picture import DrawnSensor, draw_pose, measure_turn

UP = np.array([0.0, 0, 1])
# A board in front of the robot, which looks along x: upright, and facing the robot.
FACING = se3.pose(np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]), np.array([2.0, 0, 0.3]))


def held(axis: list[float], degrees: float) -> Array:
    """The board turned about an axis of the root's frame."""
    T = FACING.copy()
    T[:3, :3] = so3.exp(np.radians(degrees) * np.array(axis)) @ T[:3, :3]
    return T


def draw(T_root_board: Array, name: str = "laser") -> str:
    sensors = [
        DrawnSensor("lidar", "lidar3d", np.eye(4)),
        DrawnSensor(name, "lidar2d", se3.pose(np.eye(3), np.array([0.3, 0.0, -0.2]))),
    ]
    return draw_pose(sensors, T_root_board, (1.2, 0.9), name)


def texts(svg: str) -> list[str]:
    return ["".join(element.itertext()) for element in ElementTree.fromstring(svg).iter() if element.text]


@pytest.mark.parametrize(
    ("axis", "degrees", "turn", "tilt"),
    [
        ([0, 0, 1], 0, "face the robot", "hold it upright"),
        # Counter-clockwise from above: the right hand of an operator behind the board moves towards the robot.
        ([0, 0, 1], 30, "right hand forward 30°", "hold it upright"),
        ([0, 0, 1], -40, "left hand forward 40°", "hold it upright"),
        ([0, 1, 0], 25, "face the robot", "top towards you 25°"),
        ([0, 1, 0], -20, "face the robot", "top towards robot 20°"),
    ],
)
def test_words_say_how_hands_and_upper_edge_move(axis: list[float], degrees: float, turn: str, tilt: str) -> None:
    T = held(axis, degrees)
    assert measure_turn(T, np.zeros(3), UP).words() == (turn, tilt)
    assert {turn, tilt} <= set(texts(draw(T)))


def test_right_hand_forward_brings_the_edge_at_the_right_of_the_operator_to_the_robot() -> None:
    # The operator looks along -x: to the right is +y, which is -x of a board that faces the robot.
    T = held([0, 0, 1], 30)
    left, right = (se3.apply(T, np.array([[x, 0.0, 0.0]]))[0] for x in (0.6, -0.6))
    operator_right = np.cross([-1.0, 0, 0], UP)
    assert (right - left) @ operator_right > 0
    assert np.linalg.norm(right) < np.linalg.norm(left)


def test_distance_is_horizontal_from_the_middle_of_the_sensors() -> None:
    assert f"{2 - 0.15:.1f} m" in texts(draw(FACING))


def test_height_is_relative_to_the_sensor_that_views_the_board() -> None:
    assert "centre 0.5 m above" in texts(draw(FACING))


def test_a_view_has_the_board_over_its_upright_outline() -> None:
    """Of a board of 1.2 by 0.9 m that faces the sensor: 116 by 87 pixels, and twice the same."""
    centred = se3.pose(FACING[:3, :3], np.array([2.0, 0, 0]))
    svg = draw_pose([DrawnSensor("lidar", "lidar3d", np.eye(4))], centred, (1.2, 0.9), "lidar")
    paths = [one.attrib for one in ElementTree.fromstring(svg).iter() if one.tag.endswith("path")]
    closed = [one["d"] for one in paths if one["d"].endswith("Z") and "stroke-width" in one][-2:]
    placed, dashed = (np.array(re.findall(r"-?[0-9.]+", path), dtype=float).reshape(4, 2) for path in closed)
    sides = np.roll(placed, -1, axis=0) - placed
    np.testing.assert_allclose(sides, [[116, 0], [0, 87], [-116, 0], [0, -87]], atol=0.11)
    np.testing.assert_array_equal(placed, dashed)


def test_names_are_text() -> None:
    svg = draw(FACING, "<b>&amp;")
    assert "<b>" not in svg
    assert "<b>&amp;" in texts(svg)


def test_pictures_are_small() -> None:
    assert len(draw(held([0, 1, 1], 30)).encode()) < 20_000
