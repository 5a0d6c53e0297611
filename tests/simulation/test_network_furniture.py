"""Chairs that are moved, and mirrors on walls."""

from typing import Any

import numpy as np
import pytest

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.simulation import (
    LayoutName,
    NetworkScenario,
    PeopleOptions,
    ScannerOptions,
    SimulatedNetwork,
    build_network,
    simulate_network_scans,
)
from calgraph.simulation.network_layouts import CHAIR_REACH

EXACT = ScannerOptions(range_noise=0, quantisation=0, mixed_pixels=0, dropout=0, resolution=1.0, max_range=30.0)


def scenario(people: int = 2, layout: LayoutName = "office", **options: Any) -> NetworkScenario:
    crowd = options.pop("people_options", {})
    return NetworkScenario(
        layout=layout, scanner=EXACT, people=PeopleOptions(count=people, **crowd), **{"duration": 60.0, **options}
    )


@pytest.fixture(scope="module")
def with_chairs() -> SimulatedNetwork:
    return build_network(scenario(chairs=4), 1)


def test_there_are_as_many_chairs_as_stated(with_chairs: SimulatedNetwork) -> None:
    assert len(with_chairs.bodies) == 2 + 4


def test_chairs_move_now_and_then_and_rest_most_of_the_time(with_chairs: SimulatedNetwork) -> None:
    moving = np.array(
        [np.linalg.norm(np.diff(c.positions, axis=0), axis=1) > 1e-6 for c in with_chairs.bodies[2:]]
    )
    assert 0.01 < moving.mean() < 0.2


def test_chairs_stay_in_their_places(with_chairs: SimulatedNetwork) -> None:
    for chair in with_chairs.bodies[2:]:
        assert np.ptp(chair.positions, axis=0).max() < 0.5
        assert with_chairs.floor.clearance(chair.positions[::100]).min() > 0.25


def test_people_walk_around_chairs(with_chairs: SimulatedNetwork) -> None:
    for chair in with_chairs.bodies[2:]:
        for walk in with_chairs.walks:
            assert np.linalg.norm(chair.positions[:6000] - walk.positions[:6000], axis=1).min() > CHAIR_REACH - 0.1


def test_of_chairs_scanners_of_legs_observe_four_legs() -> None:
    network = build_network(scenario(1, chairs=1, people_options={"shape": "legs"}), 1)
    assert len(network.bodies) == 2 + 4
    legs = np.array([leg.positions[0] for leg in network.bodies[2:]])
    assert np.ptp(legs, axis=0).max() < 0.6


def reflected(network: SimulatedNetwork, points: Array) -> Array:
    """(N, 2) images of points behind the only mirror."""
    [(a, b)] = network.mirrors
    along = (b - a) / np.linalg.norm(b - a)
    off = points - a
    return np.asarray(a + 2 * np.outer(off @ along, along) - off)


def test_in_a_mirror_scanners_measure_the_room_behind_the_wall() -> None:
    mirrored = scenario(0, mirrors=1, duration=1.0)
    network = build_network(mirrored, 1)
    scans, _ = simulate_network_scans(mirrored, 1)
    behind = 0
    for scanner in network.scanners:
        scan = scans[scanner.name][0]
        points = scan.points[:, :2] @ scanner.T_world_scanner[:2, :2].T + scanner.T_world_scanner[:2, 2]
        points = points[np.isfinite(points).all(axis=1)]
        beyond = points[network.floor.clearance(points) < -0.1]
        behind += len(beyond)
        if len(beyond):
            assert np.abs(network.floor.clearance(reflected(network, beyond))).max() < 1e-6
    assert behind > 20


def test_mirrors_are_on_walls_away_from_scanners() -> None:
    network = build_network(scenario(mirrors=2, duration=1.0), 1)
    assert network.mirrors.shape == (2, 2, 2)
    clearance = network.floor.clearance(network.mirrors.reshape(-1, 2))
    assert clearance == pytest.approx(0.02)


def test_chairs_and_mirrors_do_not_change_the_building() -> None:
    a, b = (build_network(scenario(chairs=n, mirrors=n, duration=1.0), 1) for n in (0, 2))
    assert [s.phase for s in a.scanners] == [s.phase for s in b.scanners]
    np.testing.assert_array_equal(a.floor.segments, b.floor.segments)


def test_too_many_mirrors_are_an_error() -> None:
    with pytest.raises(InputError, match=r"mirrors: 99 do not fit on the walls, only \d+ do"):
        build_network(scenario(mirrors=99, duration=1.0), 1)


@pytest.mark.parametrize("what", ["mirrors", "chairs"])
def test_the_ring_is_not_a_room(what: str) -> None:
    with pytest.raises(ValueError, match="the ring is not a room"):
        NetworkScenario.model_validate({"layout": "ring", what: 1})
