"""Colours of points from a camera's picture."""

import numpy as np
import pytest

from calgraph.sensors import CameraModel, colorize_points

CAMERA = CameraModel("pinhole", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), np.zeros(0))
# Left half blue (BGR), right half red.
PICTURE = np.zeros((480, 640, 3), dtype=np.uint8)
PICTURE[:, :320, 0] = PICTURE[:, 320:, 2] = 255


@pytest.mark.parametrize("step", [1, 2, 4])
def test_points_have_the_colours_of_their_pixels_however_small_the_picture(step: int) -> None:
    points = np.array([[-0.5, 0.0, 2.0], [0.5, 0.1, 2.0]])
    colors, visible = colorize_points(points, CAMERA, PICTURE[::step, ::step])
    assert visible.tolist() == [True, True]
    assert colors.tolist() == [[255, 0, 0], [0, 0, 255]]


def test_points_outside_the_image_and_behind_the_camera_are_not_visible() -> None:
    colors, visible = colorize_points(np.array([[9.0, 0, 2], [0, 0, -2], [0, 0, 2]]), CAMERA, PICTURE)
    assert visible.tolist() == [False, False, True]
    assert not colors[:2].any()


def test_a_wall_behind_a_board_is_occluded(rng: np.random.Generator) -> None:
    """A board 2 m away, and a wall at 5 m of which it hides the middle."""
    board = np.column_stack([rng.uniform(-0.5, 0.5, (4000, 2)), np.full(4000, 2.0)])
    wall = np.column_stack([rng.uniform(-2, 2, (4000, 2)), np.full(4000, 5.0)])
    _, visible = colorize_points(np.concatenate([board, wall]), CAMERA, PICTURE)
    # 1.5 cells of 0.02 rad, at 5 m, are 0.15 m: so near the border either may be.
    reach, hidden = np.abs(wall[:, :2]).max(axis=1), ~visible[4000:]
    assert visible[:4000].all()
    assert hidden[reach < 1.1].all()
    assert not hidden[reach > 1.25 + 0.2].any()


def test_a_slanted_floor_is_one_surface() -> None:
    """Along the sight its points lie ever farther away, and hide nothing."""
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, 40), np.linspace(3, 12, 200))
    _, visible = colorize_points(np.column_stack([x.ravel(), np.full(x.size, 1.2), z.ravel()]), CAMERA, PICTURE)
    assert visible.mean() > 0.95


def test_grey_pictures_give_grey_points() -> None:
    colors, _ = colorize_points(np.array([[0.0, 0, 2]]), CAMERA, np.full((480, 640), 90, dtype=np.uint8))
    assert colors.tolist() == [[90, 90, 90]]


def test_no_points_have_no_colours() -> None:
    colors, visible = colorize_points(np.zeros((0, 3)), CAMERA, PICTURE)
    assert colors.shape == (0, 3)
    assert visible.shape == (0,)


def at_pixel(column: float, depth: float) -> list[float]:
    return [(column - 320) / 500 * depth, 0.0, depth]


@pytest.mark.parametrize(("column", "expected"), [(319.4, [255, 0, 0]), (319.6, [0, 0, 255])])
def test_a_point_has_the_colour_of_the_nearest_pixel(column: float, expected: list[int]) -> None:
    colors, _ = colorize_points(np.array([at_pixel(column, 2.0)]), CAMERA, PICTURE)
    assert colors.tolist() == [expected]


@pytest.mark.parametrize(("depth", "expected"), [(2.15, True), (2.25, False)])
def test_points_behind_others_are_occluded_beyond_the_depth_of_a_surface(depth: float, expected: bool) -> None:
    # A surface at 2 m is 5 % and 0.1 m deep.
    _, visible = colorize_points(np.array([at_pixel(315, 2.0), at_pixel(316, depth)]), CAMERA, PICTURE)
    assert visible.tolist() == [True, expected]


def test_points_occlude_others_across_the_border_of_a_cell() -> None:
    # Cells are 0.02 rad, here 10 pixels, wide.
    _, visible = colorize_points(np.array([at_pixel(319.5, 2.0), at_pixel(320.5, 5.0)]), CAMERA, PICTURE)
    assert visible.tolist() == [True, False]
