"""Simulated floors of many equal bays with a 3-D LiDAR in each, for networks of a whole building.

Walls with openings, columns, furniture and walks are those of the planar grid; all is upright on a level floor.
"""

from dataclasses import replace

import numpy as np

from calgraph.geometry import Array, se3, so3
from calgraph.simulation.drive_world import upright
from calgraph.simulation.hall_mounts import HallMount, draw_clock, draw_columns
from calgraph.simulation.hall_people import add_person
from calgraph.simulation.hall_scenario import HallScenario
from calgraph.simulation.hall_simulation import SimulatedHall, simulate_sensors
from calgraph.simulation.hall_world import Hall
from calgraph.simulation.network_scanners import StationaryScanner
from calgraph.simulation.network_scenario import NetworkScenario, PeopleOptions
from calgraph.simulation.network_simulation import build_network
from calgraph.simulation.solids import BoxShape, Surface

_SPACING, _CEILING, _FURNITURE = 7.0, 5.0, (0.5, 1.8)
"""Of LiDARs; heights of the ceiling and of furniture, m."""
_WALKERS = 0.8
"""For each LiDAR."""
_HEIGHTS, _TILTS, _ROLL = (3.0, 4.0), (12.0, 22.0), 4.0
"""Of LiDARs over the floor, m; their tilts from the vertical, and the standard deviation of rolls, degrees."""
_POST, _WALL = 0.5, 0.16
"""Edge of a column, and thickness of walls at most, m: what is as thick reaches to the ceiling."""


def simulate_building(scenario: HallScenario) -> SimulatedHall:
    """Simulates a recording; people are as many as fit the building.

    Raises:
        InputError: there are too many people for it.
    """
    hall, mounts = build_building(scenario)
    return simulate_sensors(scenario, hall, mounts, select_near)


def build_building(scenario: HallScenario) -> tuple[Hall, tuple[HallMount, ...]]:
    """Draws the building, what moves in it, and its LiDARs."""
    count = len(scenario.lidars)
    people = PeopleOptions(
        shape="legs", count=max(2, round(_WALKERS * count)), speed=1.1, speed_spread=0.3, stop_every=12.0
    )
    network = build_network(
        NetworkScenario(
            layout="grid", grid_spacing=_SPACING, clutter=2 * count, duration=scenario.duration + 1.0,
            scanner={"count": count}, people=people,  # type: ignore[arg-type]
        ),
        scenario.seed,
    )  # fmt: skip
    rng, people_rng = (np.random.default_rng((scenario.seed, k)) for k in (10, 11))
    size = np.append(np.ptp(network.floor.outline, axis=0), _CEILING)
    room = Surface(BoxShape(*size.tolist()), upright(size / 2, 0.0), 0.5)
    surfaces = (room, *(_raise(one, rng) for one in network.floor.obstacles))
    movers = tuple(add_person(walk, people, _lie_level, people_rng) for walk in network.walks)
    mounts = []
    passed = np.concatenate([walk.positions for walk in network.walks])

    def count_near(scanner: StationaryScanner) -> int:
        return int(np.sum(np.linalg.norm(passed - scanner.T_world_scanner[:2, 2], axis=1) < _SPACING))

    # The root is where most people are.
    scanners = sorted(network.scanners, key=count_near, reverse=True)
    for k, (sensor, scanner) in enumerate(zip(scenario.sensors, scanners, strict=True)):
        clock = draw_clock(scenario, sensor, k == 0, rng)
        T = scanner.T_world_scanner
        turn = [np.arctan2(T[1, 0], T[0, 0]), np.radians(rng.uniform(*_TILTS)), np.radians(rng.normal(0, _ROLL))]
        R = np.eye(3)
        for angle, axis in zip([*turn, rng.uniform(-np.pi, np.pi)], np.eye(3)[[2, 1, 0, 2]], strict=True):
            R = R @ so3.exp(angle * axis)
        pose = se3.pose(R, np.append(T[:2, 2], rng.uniform(*_HEIGHTS)))
        mounts.append(HallMount(sensor, (pose,), draw_columns(sensor, clock.period, rng), clock))
    return Hall(size, surfaces, (), movers, network.walks, _lie_level, np.zeros((0, 3))), tuple(mounts)


def select_near(hall: Hall, mount: HallMount) -> Hall:
    """What a LiDAR of the building may measure of it."""
    place, reach = mount.poses[0][:3, 3], mount.sensor.max_range
    surfaces = tuple(
        one
        for one in hall.surfaces
        if np.linalg.norm(one.T_world_shape[:3, 3] - place) < reach + one.shape.bounding_radius
    )
    movers = tuple(
        mover
        for mover, walk in zip(hall.movers, hall.walks, strict=True)
        if np.linalg.norm(walk.positions - place[:2], axis=1).min() < reach + mover.radius
    )
    return replace(hall, surfaces=surfaces, movers=movers)


def _raise(outline: Array, rng: np.random.Generator) -> Surface:
    """A box over a rectangle (4, 2) on the floor: a wall or a column to the ceiling, or furniture."""
    along, across = outline[1] - outline[0], outline[2] - outline[1]
    length, width = float(np.hypot(*along)), float(np.hypot(*across))
    wall = min(length, width) < _WALL and max(length, width) > 1.5
    column = abs(length - _POST) < 1e-6 and abs(width - _POST) < 1e-6
    height = _CEILING if wall or column else rng.uniform(*_FURNITURE)
    place = np.append(outline.mean(axis=0), height / 2)
    return Surface(BoxShape(length, width, height), upright(place, float(np.arctan2(along[1], along[0]))), 0.5)


def _lie_level(xy: Array) -> Array:
    return np.zeros(len(xy))
