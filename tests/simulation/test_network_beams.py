"""Ranges to walls and bodies, against ones computed by hand."""

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.simulation.network_beams import (
    ScanPlane,
    View,
    build_views,
    cast_ellipses,
    cast_polygons,
    cast_segments,
    simulate_true_ranges,
)
from calgraph.simulation.network_floor import Floor, rectangle
from calgraph.simulation.network_walks import SimulatedWalk

HERE = np.zeros(2)
WALL = np.array([[[3.0, -1.0], [3.0, 1.0]]])
AXES = np.array([0.25, 0.15])


def floor_of(segments: Array) -> Floor:
    """A floor without an outer wall, with segments (S, 2, 2) as obstacles."""
    return Floor(rectangle(HERE, (100.0, 100.0)), False, tuple(segments))


def to_ellipse(angle: float, center: tuple[float, float], heading: float) -> float:
    hit = cast_ellipses(HERE, np.array([angle]), np.array([center]), np.array([heading]), AXES)
    return float(hit[0])


def walk(places: Array, start: float = 0.0) -> SimulatedWalk:
    return SimulatedWalk(AXES, start, places, np.zeros(len(places)))


def level(angles: Array) -> ScanPlane:
    return ScanPlane(HERE, angles, np.zeros(len(angles)), 0.3)


def cast(angles: Array, static: Array, times: Array, walks: list[SimulatedWalk]) -> Array:
    """Ranges of beams that hit the static environment at given distances."""
    view = View(level(angles), np.arange(len(angles)), np.zeros(len(angles)), static, static)
    return simulate_true_ranges([view], times, walks, 20.0)


def test_a_wall_straight_ahead_is_at_its_distance() -> None:
    assert cast_segments(HERE, np.array([0.0]), WALL)[0] == pytest.approx(3.0)


def test_the_range_to_an_oblique_wall() -> None:
    assert cast_segments(HERE, np.radians([15.0]), WALL)[0] == pytest.approx(3 / np.cos(np.radians(15)))


def test_a_beam_past_the_end_of_a_wall_hits_nothing() -> None:
    assert cast_segments(HERE, np.radians([20.0]), WALL)[0] == np.inf


def test_a_wall_behind_is_not_hit() -> None:
    assert cast_segments(HERE, np.array([np.pi]), WALL)[0] == np.inf


def test_a_beam_along_a_wall_does_not_divide_by_zero() -> None:
    assert cast_segments(np.array([3.0, -5.0]), np.array([np.pi / 2]), WALL)[0] == np.inf


def test_the_nearer_of_two_walls_is_hit() -> None:
    assert cast_segments(HERE, np.array([0.0]), np.concatenate([WALL, WALL - [1, 0]]))[0] == pytest.approx(2.0)


def test_a_person_who_comes_towards_the_scanner_shows_the_thin_radius() -> None:
    assert to_ellipse(0.0, (3.0, 0.0), np.pi) == pytest.approx(2.85)


def test_a_person_who_walks_across_shows_the_wide_radius() -> None:
    assert to_ellipse(0.0, (3.0, 0.0), np.pi / 2) == pytest.approx(2.75)


def test_the_silhouette_of_a_person_ends_at_the_tangent() -> None:
    # Seen from 3 m in front, the ellipse's tangent from the origin touches where 1 = w² / (d² - t²).
    edge = np.arctan(AXES[0] / np.sqrt(3**2 - AXES[1] ** 2))
    assert [np.isfinite(to_ellipse(edge + off, (3.0, 0.0), 0.0)) for off in (-1e-6, 1e-6)] == [True, False]


def test_the_point_that_is_hit_lies_on_the_turned_ellipse() -> None:
    heading, center = 0.7, np.array([2.0, 1.0])
    angle = float(np.arctan2(1.0, 2.0)) + 0.05
    point = to_ellipse(angle, (2.0, 1.0), heading) * np.array([np.cos(angle), np.sin(angle)]) - center
    along = point @ [np.cos(heading), np.sin(heading)]
    across = point @ [-np.sin(heading), np.cos(heading)]
    assert (across / 0.25) ** 2 + (along / 0.15) ** 2 == pytest.approx(1.0)


def test_each_beam_hits_a_moving_body_at_its_time_of_measurement() -> None:
    # Towards the scanner at 1 m/s, looked at by 11 beams in nearly one direction, 10 ms apart.
    places = np.column_stack([5 - 0.01 * np.arange(101), np.zeros(101)])
    angles, times = np.linspace(-1e-4, 1e-4, 11), 0.01 * np.arange(11.0)[None]
    ranges = cast(angles, np.full(11, 9.0), times, [walk(places)])
    np.testing.assert_allclose(ranges[0], 5 - 0.15 - times[0], atol=1e-6)


def test_a_body_hides_the_wall_behind_it_and_no_other() -> None:
    places = np.tile([5.0, 0.0], (101, 1))
    ranges = cast(np.array([0.0, 0.5]), np.array([9.0, 4.0]), np.zeros((1, 2)), [walk(places)])
    np.testing.assert_allclose(ranges[0], [4.85, 4.0])


def test_a_wall_hides_the_body_behind_it() -> None:
    places = np.tile([5.0, 0.0], (101, 1))
    ranges = cast(np.array([0.0]), np.array([3.0]), np.zeros((1, 1)), [walk(places)])
    assert ranges[0, 0] == 3.0


def test_a_body_is_absent_before_its_walk() -> None:
    places = np.tile([5.0, 0.0], (101, 1))
    times = np.array([[0.5], [1.5]])
    ranges = cast(np.array([0.0]), np.array([9.0]), times, [walk(places, start=1.0)])
    np.testing.assert_allclose(ranges[:, 0], [9.0, 4.85])


def test_the_preselection_of_beams_is_conservative(rng: np.random.Generator) -> None:
    steps = np.cumsum(rng.normal(0, 0.01, (1000, 2)), axis=0)
    body = walk(np.array([1.0, -0.6]) + steps)
    angles = np.linspace(-np.pi, np.pi, 721)
    times: Array = 0.2 * np.arange(40)[:, None] + 0.1 * np.arange(721) / 721
    ranges = cast(angles, np.full(721, np.inf), times, [body])
    centers, headings = body.pose_at(times.ravel())
    every = cast_ellipses(HERE, np.tile(angles, 40), centers, headings, AXES)
    np.testing.assert_array_equal(ranges.ravel(), every)


def test_a_fast_body_is_hit_by_all_beams_of_a_slow_scan() -> None:
    body = walk(np.column_stack([np.full(101, 2.0), -1.5 + 0.035 * np.arange(101)]))
    angles = np.linspace(-1.0, 1.0, 201)
    times = np.linspace(0.0, 0.9, 201)[None]
    ranges = cast(angles, np.full(201, np.inf), times, [body])
    every = cast_ellipses(HERE, angles, *body.pose_at(times[0]), AXES)
    assert np.isfinite(every).sum() > 20
    np.testing.assert_array_equal(ranges[0], every)


def test_beams_hit_a_polygon_as_they_hit_the_ellipse_that_it_approximates() -> None:
    angle = 2 * np.pi * np.arange(720) / 720
    outline = np.column_stack([0.15 * np.cos(angle), 0.25 * np.sin(angle)])
    beams = np.linspace(-0.2, 0.2, 101)
    centers, headings = np.tile([3.0, 0.1], (101, 1)), np.linspace(0, 3, 101)
    ellipse = cast_ellipses(np.zeros(2), beams, centers, headings, np.array([0.25, 0.15]))
    polygon = cast_polygons(np.zeros(2), beams, centers, headings, outline, np.ones(101))
    both = np.isfinite(ellipse) & np.isfinite(polygon)
    assert both.sum() > 20
    assert np.abs(ellipse[both] - polygon[both]).max() < 2e-3
    assert (np.isfinite(ellipse) != np.isfinite(polygon)).sum() <= 2


def test_beams_along_the_sides_of_a_square_pass_beside_it() -> None:
    square = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    centers = np.array([(5.0, 0.0), (5.0, 1.5), (-5.0, 0.0)])
    hits = cast_polygons(np.zeros(2), np.zeros(3), centers, np.zeros(3), square, np.ones(3))
    assert hits.tolist() == [4.0, np.inf, np.inf]


def test_a_mirror_shows_the_wall_and_the_body_behind_the_scanner() -> None:
    # The mirror is 2 m ahead, a wall 3 m behind; a body stands 1 m behind the scanner.
    mirror, wall = np.array([[[2.0, -1.0], [2.0, 1.0]]]), np.array([[[-3.0, -1.0], [-3.0, 1.0]]])
    views = build_views(level(np.zeros(1)), floor_of(wall), mirror, np.array([np.inf]))
    body = walk(np.tile([-1.0, 0.0], (101, 1)))
    ranges = [simulate_true_ranges(views, np.zeros((1, 1)), bodies, 20.0)[0, 0] for bodies in ([], [body])]
    assert ranges == pytest.approx([7.0, 4.85])


def test_a_body_before_the_mirror_hides_it_and_one_behind_it_is_not_measured() -> None:
    mirror = np.array([[[2.0, -1.0], [2.0, 1.0]]])
    views = build_views(level(np.zeros(1)), floor_of(WALL), mirror, np.array([np.inf]))
    bodies = [walk(np.tile([x, 0.0], (101, 1))) for x in (1.0, 2.5)]
    ranges = [simulate_true_ranges(views, np.zeros((1, 1)), [body], 20.0)[0, 0] for body in bodies]
    assert ranges == pytest.approx([0.85, np.inf])
