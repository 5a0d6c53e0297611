"""A rectangle of known size in a patch, and the beams through it and around it."""

import numpy as np
import pytest

from calgraph.config.settings import DetectionSettings
from calgraph.geometry import Array
from calgraph.rig.detection.rectangle_fit import (
    OUTLINE_BLUR,
    BoardRectangle,
    fit_rectangle,
    measure_solidity_and_isolation,
)

SIZE = (1.0, 0.6)
PLANE = np.array([0.0, 0.0, -1.0, 2.0])
"""z = 2, seen from the origin."""
BLUR = OUTLINE_BLUR


def grid(width: float, height: float, step: float = 0.02) -> Array:
    x, y = np.arange(-width / 2 + step / 2, width / 2, step), np.arange(-height / 2 + step / 2, height / 2, step)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def cells(flat: Array, angle: float = 0.0, center: tuple[float, float] = (0.0, 0.0)) -> Array:
    """Points (M, 3) on the plane."""
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([flat @ np.array([[c, s], [-s, c]]) + center, np.full(len(flat), 2.0)])


def fit(points: Array) -> BoardRectangle:
    return fit_rectangle(PLANE, points, SIZE, 0.012, BLUR)


@pytest.mark.parametrize("degrees", [0, 30, 45, 75, 110, 160])
def test_the_rectangle_is_found_at_any_rotation(degrees: float) -> None:
    angle = np.radians(degrees)
    rectangle = fit(cells(grid(*SIZE), angle, (0.3, -0.2)))
    np.testing.assert_allclose(rectangle.center, [0.3, -0.2, 2.0], atol=0.01)
    assert (rectangle.covered, rectangle.contained) == (1.0, 1.0)
    along = abs(rectangle.axes[:, 0] @ [np.cos(angle), np.sin(angle), 0])
    assert along > np.cos(np.radians(2.6))
    np.testing.assert_allclose(rectangle.axes.T @ rectangle.axes, np.eye(2), atol=1e-12)


def test_half_a_board_covers_half_of_the_rectangle() -> None:
    rectangle = fit(cells(grid(0.5, 0.6)))
    assert rectangle.covered == pytest.approx(0.5, abs=0.05)
    assert rectangle.contained == 1.0


def test_a_larger_patch_is_contained_in_part() -> None:
    rectangle = fit(cells(grid(2.0, 1.2)))
    assert rectangle.covered == 1.0
    assert rectangle.contained == pytest.approx((1.0 + 2 * BLUR) * (0.6 + 2 * BLUR) / 2.4, abs=0.03)


def test_a_stand_beside_the_board_is_outside() -> None:
    stand = grid(0.06, 0.4) + np.array([0.1, -0.52])
    rectangle = fit(cells(np.concatenate([grid(*SIZE), stand])))
    np.testing.assert_allclose(rectangle.center, [0, 0, 2], atol=0.045)
    assert rectangle.contained == pytest.approx(1500 / 1560, abs=0.01)


def scene(*parts: tuple[Array, float]) -> Array:
    """Points of beams through places (N, 2) of the plane that end at a multiple of its distance."""
    return np.concatenate([factor * cells(flat) for flat, factor in parts])


def shares(points: Array, frame: float = 0.15) -> tuple[float, float]:
    rectangle = fit(cells(grid(*SIZE)))
    beams = points, np.linalg.norm(points, axis=1)
    return measure_solidity_and_isolation(rectangle, beams, 0.03, frame, DetectionSettings())


def ring(inner: float, outer: float) -> Array:
    """Places whose distance outside the rectangle is in this range, m."""
    flat = grid(1.6, 1.2, 0.01)
    outside = np.max(np.abs(flat) - 0.5 * np.array(SIZE), axis=1)
    return np.asarray(flat[(outside > inner) & (outside < outer)])


def test_a_board_in_front_of_a_wall_is_solid_and_isolated() -> None:
    assert shares(scene((grid(*SIZE), 1.0), (ring(0.0, 0.3), 2.0))) == (1.0, 1.0)


def test_a_part_of_a_wall_is_not_isolated() -> None:
    assert shares(scene((grid(1.6, 1.2), 1.0))) == (1.0, 0.0)


def test_holes_are_not_solid() -> None:
    flat = grid(*SIZE)
    hole = np.abs(flat[:, 0]) < 0.2
    solid, _ = shares(scene((flat[~hole], 1.0), (flat[hole], 2.0)))
    inside = np.max(np.abs(flat) - 0.5 * np.array(SIZE), axis=1) < -BLUR
    assert solid == pytest.approx((inside & ~hole).sum() / inside.sum(), abs=0.02)


def test_beams_that_end_before_the_board_do_not_count() -> None:
    flat = grid(*SIZE)
    assert shares(scene((flat[::2], 1.0), (flat[1::2], 0.7), (ring(0.1, 0.15), 2.0))) == (1.0, 1.0)


def test_beams_just_behind_the_board_do_not_count() -> None:
    """Less than the depth jump of 0.1 m they are neither on it nor through it."""
    flat = grid(*SIZE)
    assert shares(scene((flat[::2], 1.0), (flat[1::2], 1.04)))[0] == 1.0
    assert shares(scene((flat[::2], 1.0), (flat[1::2], 1.06)))[0] == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(
    ("inner", "outer", "isolated"), [(0.0, 0.055, 1.0), (0.062, 0.085, 0.0), (0.15, 0.205, 0.0), (0.215, 0.3, 1.0)]
)
def test_isolation_is_that_of_the_frame(inner: float, outer: float, isolated: float) -> None:
    """It begins at twice the blur, 0.06 m, and is 0.15 m wide."""
    assert shares(scene((grid(*SIZE), 1.0), (ring(inner, outer), 1.0)))[1] == isolated


def test_isolation_is_a_share_of_beams() -> None:
    frame = ring(0.07, 0.2)
    on_plane = np.arange(len(frame)) % 4 == 0
    _, isolation = shares(scene((frame[on_plane], 1.0), (frame[~on_plane], 2.0)))
    assert isolation == pytest.approx(0.75, abs=0.01)


def test_without_beams_both_are_one() -> None:
    assert shares(np.array([[0.0, 0.0, -3.0], [3.0, 0.0, 0.5]])) == (1.0, 1.0)
