"""The layout for any number of scanners, and that what it costs is in proportion to them."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.io.yaml_reading import validate_content
from calgraph.simulation import (
    NetworkScenario,
    SimulatedNetwork,
    StationaryScanner,
    build_network,
    network_beams,
    network_floor,
)
from calgraph.simulation.network_beams import build_views, cast_walls
from calgraph.simulation.network_layouts import build_layout
from network_measures import build_floor

FEW, MANY = 32, 128


def building(count: int, duration: float = 4.0) -> NetworkScenario:
    return NetworkScenario.model_validate(
        {
            "layout": "building",
            "clutter": 2 * count,
            "duration": duration,
            "scanner": {"count": count},
            "people": {"count": round(0.4 * count)},
        }
    )


@cache
def network(count: int) -> SimulatedNetwork:
    return build_network(building(count), 0)


@pytest.mark.parametrize("count", [*range(8, 40), 100, 333])
def test_a_building_has_a_place_for_every_scanner(count: int) -> None:
    scenario = building(count).model_copy(update={"clutter": 0})
    assert len(build_layout(scenario, np.random.default_rng(0)).mounts) == count


@pytest.mark.parametrize("count", [8, 30, 100])
def test_scanners_stand_in_free_space(count: int) -> None:
    floor, scanners = build_floor(building(count))
    places = np.array([scanner.T_world_scanner[:2, 2] for scanner in scanners])
    assert floor.clearance(places).min() >= 0.15


@pytest.mark.parametrize("count", [8, 30, 100])
def test_views_of_all_scanners_overlap_where_people_can_be(count: int) -> None:
    floor, scanners = build_floor(building(count))
    space = network_floor.find_free_space(floor, 0.5, np.zeros((0, 3)))
    places = (space.corner + 0.2 * np.argwhere(space.free))[::10]
    seen = np.array([sees(floor, scanner, places) for scanner in scanners], dtype=np.float64)
    # A square metre has 2.5 of these places.
    together = seen @ seen.T >= 5
    assert connected_components(together)[0] == 1


def sees(floor: network_floor.Floor, scanner: StationaryScanner, places: Array) -> NDArray[np.bool_]:
    """Whether a scanner has each of places (N, 2) in its line of sight, field of view and range."""
    off = places - scanner.T_world_scanner[:2, 2]
    distance, angle = np.hypot(*off.T), np.arctan2(off[:, 1], off[:, 0])
    facing = np.arctan2(scanner.T_world_scanner[1, 0], scanner.T_world_scanner[0, 0])
    turn = np.abs(np.remainder(angle - facing + np.pi, 2 * np.pi) - np.pi)
    near = (distance < scanner.options.max_range) & (turn < np.radians(scanner.options.field_of_view / 2))
    near[near] &= cast_walls(scanner.T_world_scanner[:2, 2], angle[near], floor) > distance[near]
    return np.asarray(near)


def test_fewer_scanners_than_a_hall_has_are_an_error() -> None:
    with pytest.raises(InputError, match=r"scanner\.count: of a building must be at least 8, got 7"):
        validate_content(NetworkScenario, {"layout": "building", "scanner": {"count": 7}}, Path("options"))


def test_people_walk_through_doors() -> None:
    """Between corridors, which are 3 m wide and 15 m apart, and blocks."""
    inside = outside = 0
    for walk in build_network(building(30, duration=30.0), 0).walks:
        in_corridor = np.remainder(walk.positions[:, 1], 15.0) < 3.0
        inside += int((~in_corridor).any())
        outside += int(in_corridor.any())
    assert min(inside, outside) >= 6


def test_segments_that_are_cast_for_a_scanner_do_not_grow_with_the_building(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cast, original = list[int](), network_beams.cast_segments

    def count(origin: Array, angles: Array, segments: Array, *rest: Array) -> Array:
        cast.append(len(angles) * len(segments))
        return original(origin, angles, segments, *rest)

    monkeypatch.setattr(network_beams, "cast_segments", count)

    def cost(of: SimulatedNetwork) -> float:
        cast.clear()
        for scanner in of.scanners:
            plane = scanner.plane_at(scanner.T_world_scanner)
            build_views(plane, of.floor, of.mirrors, np.full(len(plane.angles), np.inf))
        return sum(cast) / len(of.scanners)

    assert len(network(MANY).floor.segments) > 3 * len(network(FEW).floor.segments)
    assert cost(network(MANY)) < 1.5 * cost(network(FEW))


def test_bodies_that_are_cast_for_a_scanner_do_not_grow_with_the_building() -> None:
    def cost(of: SimulatedNetwork) -> float:
        times = np.array([[0.0, 0.05], [3.9, 3.95]])
        planes = [scanner.plane_at(scanner.T_world_scanner) for scanner in of.scanners]
        views = [build_views(plane, of.floor, of.mirrors, np.full(len(plane.angles), np.inf)) for plane in planes]
        return float(np.mean([len(of.find_bodies(one, times, 10.0)) for one in views]))

    # The smaller building is hardly larger than what a scanner has in its range.
    assert cost(network(MANY)) < 2 * cost(network(FEW))


def test_cells_in_which_a_path_is_planned_do_not_grow_with_the_building(monkeypatch: pytest.MonkeyPatch) -> None:
    cells, original = list[int](), network_floor._build_graph

    def count(free: NDArray[np.bool_], clearance: Array, min_clearance: float) -> csr_array:
        cells.append(free.size)
        return original(free, clearance, min_clearance)

    monkeypatch.setattr(network_floor, "_build_graph", count)
    build_network(building(MANY), 0)
    # Goals are within 25 m along each axis, and paths within as much beyond them, on cells of 0.2 m.
    assert max(cells) <= (4 * 25 / 0.2 + 3) ** 2


def test_clearance_is_that_from_all_walls(rng: np.random.Generator) -> None:
    floor = network(FEW).floor
    points = rng.uniform(floor.outline.min(axis=0), floor.outline.max(axis=0), (500, 2))
    sides = [network_floor.polygon_sides(polygon) for polygon in (floor.outline, *floor.obstacles)]
    every = network_floor.distance_to_segments(points, np.concatenate(sides))
    np.testing.assert_array_equal(np.abs(floor.clearance(points)), every)


def test_walls_that_are_near_give_the_ranges_of_all_walls() -> None:
    of = network(FEW)
    for scanner in of.scanners:
        plane = scanner.plane_at(scanner.T_world_scanner)
        every = network_beams.cast_segments(plane.origin, plane.angles, of.floor.segments)
        np.testing.assert_array_equal(cast_walls(plane.origin, plane.angles, of.floor), every)
