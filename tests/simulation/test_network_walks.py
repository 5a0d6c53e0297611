"""People on their walks: never in walls or in each other, at the speed asked for, facing where they go."""

from itertools import combinations

import numpy as np
import pytest

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.simulation import LayoutName, NetworkScenario, PeopleOptions, SimulatedNetwork, build_network
from calgraph.simulation.network_floor import Floor, find_free_space, rectangle
from calgraph.simulation.network_walks import SimulatedWalk, _choose_velocity, _Walker

CROWD = PeopleOptions(count=4)


def outline(walk: SimulatedWalk, every: int = 10) -> Array:
    """(N, 2) points around a body at some of its samples."""
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    h, places = walk.headings[::every, None], walk.positions[::every, None]
    across, along = walk.axes[0] * np.cos(angle), walk.axes[1] * np.sin(angle)
    x, y = along * np.cos(h) - across * np.sin(h), along * np.sin(h) + across * np.cos(h)
    return np.asarray((places + np.stack([x, y], axis=-1)).reshape(-1, 2))


def speeds(walk: SimulatedWalk) -> Array:
    return np.asarray(np.linalg.norm(np.gradient(walk.positions, 0.01, axis=0), axis=1))


@pytest.fixture(scope="module")
def office() -> SimulatedNetwork:
    return build_network(NetworkScenario(people=CROWD), 1)


@pytest.mark.parametrize("layout", ["ring", "office", "semicircle", "lab", "halls"])
@pytest.mark.parametrize("seed", [0, 1])
def test_no_body_ever_touches_a_wall(layout: LayoutName, seed: int) -> None:
    network = build_network(NetworkScenario(layout=layout, people=CROWD, duration=20.0), seed)
    assert min(network.floor.clearance(outline(walk)).min() for walk in network.walks) > 0.02


@pytest.mark.parametrize("layout", ["office", "lab", "halls"])
def test_no_two_bodies_ever_touch(layout: LayoutName) -> None:
    network = build_network(NetworkScenario(layout=layout, people=CROWD, duration=40.0), 2)
    apart = [np.linalg.norm(a.positions - b.positions, axis=1).min() for a, b in combinations(network.walks, 2)]
    assert min(apart) > 2 * CROWD.reach


def test_walks_keep_clear_of_scanners(office: SimulatedNetwork) -> None:
    places = np.concatenate([walk.positions for walk in office.walks])
    near = [np.linalg.norm(places - s.T_world_scanner[:2, 2], axis=1).min() for s in office.scanners]
    assert min(near) > CROWD.reach


def test_people_walk_at_their_speed_most_of_the_time(office: SimulatedNetwork) -> None:
    usual = np.median(np.concatenate([speeds(walk) for walk in office.walks]))
    assert usual == pytest.approx(1.2, abs=0.2)


def test_speeds_are_bounded(office: SimulatedNetwork) -> None:
    assert max(speeds(walk).max() for walk in office.walks) < 1.2 * 1.15 + 0.01


def test_people_stop_now_and_then(office: SimulatedNetwork) -> None:
    assert 0.02 < np.mean([speeds(walk) < 0.02 for walk in office.walks]) < 0.4


def test_a_single_person_without_stops_never_stands() -> None:
    people = PeopleOptions(count=1, stop_every=0.0)
    [walk] = build_network(NetworkScenario(people=people, duration=20.0, clutter=0), 0).walks
    assert np.mean(speeds(walk) < 0.02) < 0.02


def test_headings_follow_the_velocity(office: SimulatedNetwork) -> None:
    for walk in office.walks:
        velocity = np.gradient(walk.positions, 0.01, axis=0)
        moving = np.linalg.norm(velocity, axis=1) > 0.8
        facing = np.column_stack([np.cos(walk.headings), np.sin(walk.headings)])
        along = (velocity * facing).sum(axis=1) / np.maximum(np.linalg.norm(velocity, axis=1), 1e-9)
        assert np.median(along[moving]) > 0.99


def test_sizes_spread_as_stated() -> None:
    people = PeopleOptions(count=8, axes_spread=0.2)
    ratios = np.array(
        [w.axes / people.axes for w in build_network(NetworkScenario(people=people, duration=1.0), 0).walks]
    )
    assert (bool(np.ptp(ratios) > 0.1), bool(np.abs(ratios - 1).max() <= 0.2)) == (True, True)


def test_a_cylinder_is_round() -> None:
    people = PeopleOptions(kind="cylinder", count=1, diameter=0.6)
    [walk] = build_network(NetworkScenario(people=people, duration=1.0), 0).walks
    assert walk.axes.tolist() == [0.3, 0.3]


def test_between_its_samples_a_walk_is_straight() -> None:
    walk = SimulatedWalk(
        np.array([0.25, 0.15]), 2.0, np.array([[0.0, 0.0], [0.01, 0.0], [0.02, 0.0]]), np.array([0, 0.1, 0.2])
    )
    places, headings = walk.pose_at(np.array([2.015]))
    assert [*places[0], headings[0]] == pytest.approx([0.015, 0.0, 0.15])


def test_poses_before_the_walk_are_nan() -> None:
    walk = SimulatedWalk(np.array([0.25, 0.15]), 2.0, np.zeros((3, 2)), np.zeros(3))
    assert np.isnan(walk.pose_at(np.array([1.99]))[0]).all()


def test_twelve_people_on_a_grid_keep_moving() -> None:
    network = build_network(NetworkScenario(layout="grid", duration=10.0), 0)
    lengths = [speeds(walk).sum() * 0.01 for walk in network.walks]
    assert np.median(lengths) > 8


def test_too_many_people_are_an_error() -> None:
    crowded = NetworkScenario(layout="lab", people=PeopleOptions(count=60), duration=1.0)
    with pytest.raises(InputError, match=r"people\.count: 60 do not fit on the floor, only \d+ do"):
        build_network(crowded, 0)


def test_a_clearance_without_free_space_is_an_error() -> None:
    with pytest.raises(InputError, match=r"people\.clearance: no free space"):
        build_network(NetworkScenario(layout="lab", people=PeopleOptions(clearance=3.0)), 0)


FREE = find_free_space(Floor(rectangle((0, 0), (20, 20)), True, ()), 0.4, np.zeros((0, 3)))


def walker(position: Array, velocity: Array) -> _Walker:
    return _Walker(np.array([0.25, 0.15]), 0.25, FREE, 1.2, np.zeros((0, 2)), np.inf, position, velocity)


def choose_turn(places: Array, side: float) -> float:
    """Turn in degrees, NaN for standing, of a walker who wants to go along x, where people stand at places (N, 2).

    All is mirrored at x where the side is -1.
    """
    mirror = np.array([1.0, side])
    others = [walker(place * mirror, np.zeros(2)) for place in places]
    # It moves a little to one side: no two turns cost the same.
    me = walker(np.zeros(2), np.array([1.15, 0.2]) * mirror)
    x, y = _choose_velocity(me, np.array([1.0, 0.0]), others, PeopleOptions())
    return round(float(np.degrees(np.arctan2(y, x)))) if x or y else np.nan


def test_walkers_evade_people_to_either_side_alike() -> None:
    """At random places around, from 0.7 to 2 m away: the more turns are blocked, the larger is the turn."""
    rng, turns = np.random.default_rng(0), []
    for _ in range(200):
        angle, distance = rng.uniform(-2, 2, 4), rng.uniform(0.7, 2.0, 4)
        places = (distance * np.stack([np.cos(angle), np.sin(angle)])).T
        turns.append((choose_turn(places, 1.0), choose_turn(places, -1.0)))
    left, right = np.array(turns).T
    np.testing.assert_array_equal(left, -right)
    assert set(np.abs(left[np.isfinite(left)])) == {0, 15, 30, 50, 75, 105, 150}
