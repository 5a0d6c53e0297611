"""Floors: what is inside, how far walls are, and the free_space around them."""

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.simulation import LayoutName, NetworkScenario, ScannerOptions
from calgraph.simulation.network_floor import (
    Floor,
    FreeSpace,
    distance_to_segments,
    find_free_space,
    points_inside,
    polygon_sides,
    rectangle,
)
from calgraph.simulation.network_layouts import build_layout

NO_SCANNERS = np.zeros((0, 2))
ROOM = rectangle((5.0, 2.5), (10.0, 5.0))
LAYOUTS: tuple[LayoutName, ...] = ("ring", "office", "semicircle", "lab", "halls", "grid")


def divided(gap: float) -> Floor:
    """A room of 10 x 5 m with a wall across at x = 5 that leaves a gap open at its upper end."""
    return Floor(ROOM, True, (rectangle((5.0, (5 - gap) / 2), (0.2, 5 - gap)),))


def free_space(floor: Floor, scanners: Array = NO_SCANNERS) -> FreeSpace:
    return find_free_space(floor, 0.4, np.column_stack([scanners, np.full(len(scanners), 0.5)]))


def test_a_rectangle_turned_a_quarter_swaps_its_sides() -> None:
    np.testing.assert_allclose(np.ptp(rectangle((1, 1), (4, 2), np.pi / 2), axis=0), [2, 4])


def test_a_point_in_the_notch_of_a_polygon_is_outside() -> None:
    corner = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], dtype=np.float64)
    assert points_inside(corner, np.array([(0.5, 1.5), (1.5, 1.5), (1.5, 0.5)])).tolist() == [True, False, True]


def test_distances_end_at_the_ends_of_a_segment() -> None:
    segment = np.array([[[0.0, 0.0], [2.0, 0.0]]])
    distances = distance_to_segments(np.array([(1.0, 3.0), (5.0, 4.0)]), segment)
    np.testing.assert_allclose(distances, [3.0, 5.0])


def test_clearance_is_the_distance_from_the_nearest_wall() -> None:
    assert Floor(ROOM, True, ()).clearance(np.array([[3.0, 1.5]]))[0] == pytest.approx(1.5)


def test_clearance_in_an_obstacle_is_negative() -> None:
    assert divided(1.5).clearance(np.array([[5.0, 1.0]]))[0] == pytest.approx(-0.1)


def test_beams_pass_an_outline_that_is_no_wall() -> None:
    assert len(Floor(ROOM, False, ()).segments) == 0


def test_a_path_leads_around_a_wall() -> None:
    way = free_space(divided(1.5)).plan_path(np.array([2.0, 1.0]), np.array([8.0, 1.0]))
    assert way[:, 1].max() > 3.5 + 0.4


def test_a_path_connects_start_and_goal() -> None:
    way = free_space(divided(1.5)).plan_path(np.array([2.0, 1.0]), np.array([8.0, 1.0]))
    np.testing.assert_allclose(way[[0, -1]], [(2, 1), (8, 1)], atol=0.2)


def test_free_space_keeps_clear_of_walls() -> None:
    floor = divided(1.5)
    way = free_space(floor).plan_path(np.array([2.0, 1.0]), np.array([8.0, 1.0]))
    assert floor.clearance(way).min() >= 0.4


def test_a_narrow_gap_is_blocked() -> None:
    free = free_space(divided(0.6))
    assert np.ptp(free.corner[0] + 0.2 * np.argwhere(free.free)[:, 0]) < 5


def test_free_space_keeps_clear_of_scanners() -> None:
    free = free_space(Floor(ROOM, True, ()), np.array([[5.0, 2.5]]))
    way = free.plan_path(np.array([1.0, 2.5]), np.array([9.0, 2.5]))
    assert np.linalg.norm(way - [5.0, 2.5], axis=1).min() >= 0.5


@pytest.mark.parametrize(
    ("layout", "low", "high"),
    [
        ("office", (0, 0), (16, 11)), ("semicircle", (-8, -2), (8, 9)), ("lab", (0, 0), (8, 7)),
        ("halls", (0, 0), (26, 26)),
    ],
)  # fmt: skip
def test_rooms_have_their_sizes(layout: LayoutName, low: tuple[int, int], high: tuple[int, int]) -> None:
    outline = build_layout(NetworkScenario(layout=layout), np.random.default_rng(0)).floor.outline
    np.testing.assert_allclose([outline.min(axis=0), outline.max(axis=0)], [low, high], atol=1e-12)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_scanners_have_a_free_view(layout: LayoutName) -> None:
    plan = build_layout(NetworkScenario(layout=layout), np.random.default_rng(3))
    assert distance_to_segments(plan.mounts[:, :2], plan.floor.segments).min() >= 0.15


@pytest.mark.parametrize("layout", LAYOUTS)
def test_scanners_face_the_room(layout: LayoutName) -> None:
    still = ScannerOptions(position_jitter=0, yaw_jitter=0)
    plan = build_layout(NetworkScenario(layout=layout, scanner=still, clutter=0), np.random.default_rng(0))
    ahead = plan.mounts[:, :2] + 1.2 * np.column_stack([np.cos(plan.mounts[:, 2]), np.sin(plan.mounts[:, 2])])
    assert plan.floor.clearance(ahead).min() > 0.1


@pytest.mark.parametrize("count", [2, 7, 12, 30])
def test_a_grid_has_a_bay_for_each_scanner(count: int) -> None:
    scenario = NetworkScenario(layout="grid", scanner=ScannerOptions(count=count), clutter=0)
    mounts = build_layout(scenario, np.random.default_rng(0)).mounts[:, :2]
    apart = np.linalg.norm(mounts[:, None] - mounts, axis=-1) + 100 * np.eye(count)
    assert (len(mounts), bool(apart.min() > 2)) == (count, True)


def test_the_office_has_the_stated_number_of_pieces_of_furniture() -> None:
    plan = build_layout(NetworkScenario(clutter=9), np.random.default_rng(0))
    assert len(plan.floor.obstacles) == 9


def test_furniture_leaves_a_passage_to_walls() -> None:
    floor = build_layout(NetworkScenario(), np.random.default_rng(0)).floor
    walls = polygon_sides(floor.outline)
    assert min(distance_to_segments(piece, walls).min() for piece in floor.obstacles) >= 0.9


def test_furniture_leaves_scanners_a_free_view_of_80_centimetres() -> None:
    scenario, nearest = NetworkScenario(layout="office", clutter=60), []
    for seed in range(3):
        plan = build_layout(scenario, np.random.default_rng(seed))
        sides = np.concatenate([polygon_sides(polygon) for polygon in plan.floor.obstacles])
        nearest.append(distance_to_segments(plan.mounts[:, :2], sides).min())
    assert 0.8 <= min(nearest) < 1.5
