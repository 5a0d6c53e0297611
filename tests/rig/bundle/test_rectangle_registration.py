"""Rectangles are registered to points on their outlines, if these determine the pose."""

import numpy as np
import pytest

from calgraph.geometry import Array, se3, so3
from calgraph.rig.bundle.board_outlines import _limited_mean, _offsets_from_sides, register_rectangles

HALF = np.array([0.42, 0.30])


def on_outline(rng: np.random.Generator, half: Array, count: int, noise: float = 0.003) -> Array:
    """(count, 2) points all along the four sides."""
    side, along = rng.integers(4, size=count), rng.uniform(-1, 1, count)
    across = 2.0 * (side % 2) - 1
    x, y = np.where(side < 2, across, along), np.where(side < 2, along, across)
    return np.asarray(half * np.stack([x, y], axis=-1) + rng.normal(scale=noise, size=(count, 2)))


def placed(points: Array, turn: float, shift: Array) -> tuple[Array, Array]:
    """The points after a motion of the rectangle in its plane, and that motion (4, 4)."""
    T = se3.pose(so3.exp(np.array([0.0, 0.0, turn])), np.append(shift, 0.0))
    return se3.apply(T, np.column_stack([points, np.zeros(len(points))]))[:, :2], T


def test_rectangles_are_registered_to_their_outlines(rng: np.random.Generator) -> None:
    turns, shifts = rng.uniform(0, np.pi, 50), rng.uniform(-0.2, 0.2, (50, 2))
    moved = [placed(on_outline(rng, HALF, 30), turn, shift) for turn, shift in zip(turns, shifts, strict=True)]
    found, certain = register_rectangles([points for points, _ in moved], HALF)
    assert certain.mean() > 0.9
    T = np.array([T for _, T in moved])
    off = se3.difference(found, T)
    # A rectangle looks the same upside down.
    turned = np.abs((off[:, 5] + np.pi / 2) % np.pi - np.pi / 2)
    assert np.linalg.norm(off[certain, :2], axis=1).max() < 0.01
    assert np.degrees(turned[certain].max()) < 2.5


def test_a_square_is_ambiguous(rng: np.random.Generator) -> None:
    square = np.array([0.35, 0.35])
    points, _ = placed(on_outline(rng, square, 40), 0.4, np.zeros(2))
    assert register_rectangles([points], square)[1].tolist() == [False]


@pytest.mark.parametrize("count", [0, 5])
def test_few_points_do_not_suffice(rng: np.random.Generator, count: int) -> None:
    found, certain = register_rectangles([on_outline(rng, HALF, count)], HALF)
    np.testing.assert_array_equal(found, np.eye(4)[None])
    assert not certain.any()


def test_a_rectangle_of_another_size_is_not_registered(rng: np.random.Generator) -> None:
    points, _ = placed(on_outline(rng, 0.6 * HALF, 40), 1.0, np.zeros(2))
    assert register_rectangles([points], HALF)[1].tolist() == [False]


def test_no_rectangles_are_none() -> None:
    found, certain = register_rectangles([], HALF)
    assert (found.shape, certain.shape) == ((0, 4, 4), (0,))


def draw_sides(*sides: tuple[tuple[float, float], tuple[float, float]]) -> Array:
    """Twenty points on each side between two corners, in units of half the rectangle's size."""
    t = np.linspace(0, 1, 20)[:, None]
    return np.concatenate([HALF * (np.array(a) + t * (np.array(b) - np.array(a))) for a, b in sides])


@pytest.mark.parametrize(
    "points",
    [
        draw_sides(((-1, -1), (-1, 1)), ((-1, 1), (0.6, 1)), ((-1, -1), (0.6, -1))),
        draw_sides(((-1, -1), (1, -1)), ((-1, -1), (-1, 0.6)), ((1, -1), (1, 0.6))),
    ],
    ids=["without the right", "without the top"],
)
def test_three_sides_of_a_rectangle_suffice(points: Array) -> None:
    """The middle of the points is 84 or 60 mm from the centre."""
    found, certain = register_rectangles([points + np.array([0.1, 0.05])], HALF)
    assert certain.all()
    np.testing.assert_allclose(found[0, :3, 3], [0.1, 0.05, 0], atol=1e-3)


def test_rectangles_are_registered_independently(rng: np.random.Generator) -> None:
    """One has more points than the other, whose points are padded."""
    points = [placed(on_outline(rng, HALF, count), 0.3, np.array([0.1, 0.0]))[0] for count in (12, 60)]
    together, _ = register_rectangles(points, HALF)
    alone = np.concatenate([register_rectangles([one], HALF)[0] for one in points])
    np.testing.assert_allclose(together, alone, atol=1e-9)


@pytest.mark.parametrize(("valid", "mean"), [
    ([False, False, False], 0.0), ([True, False, False], 0.02), ([True, True, False], -0.015),
])  # fmt: skip
def test_means_are_of_valid_values_truncated_at_the_limit(valid: list[bool], mean: float) -> None:
    assert _limited_mean(np.array([0.02, -0.3, 7.0]), np.array(valid)) == pytest.approx(mean)


@pytest.mark.parametrize(
    ("point", "axis"), [((0.9, 0.5), 0), ((0.5, 0.9), 1), ((1.3, 0.9), 0), ((0.9, 1.3), 1), ((-1.3, -0.9), 0)]
)
def test_the_nearest_side_is_that_of_the_nearest_outline_point(point: tuple[float, float], axis: int) -> None:
    """Also of points outside, in front of a side near its end."""
    off, nearest = _offsets_from_sides(HALF * np.array([point]), HALF)
    assert nearest.tolist() == [axis]
    np.testing.assert_allclose(off, HALF * (np.array([point]) - np.sign([point])))
