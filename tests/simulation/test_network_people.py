"""Couples, carts, trolleys and skirts: where they are, and what beams hit of them."""

from typing import Any

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.simulation import NetworkScenario, PeopleOptions, SimulatedNetwork, build_network
from calgraph.simulation.network_walks import SimulatedWalk


def network(seed: int = 1, duration: float = 30.0, **people: Any) -> SimulatedNetwork:
    return build_network(NetworkScenario(duration=duration, people=PeopleOptions(**people)), seed)


def in_frame_of(walk: SimulatedWalk, body: SimulatedWalk) -> Array:
    """(K, 2) a body's centre ahead and to the left of a walk, m."""
    c, s = np.cos(walk.headings), np.sin(walk.headings)
    x, y = (body.positions - walk.positions).T
    return np.column_stack([c * x + s * y, -s * x + c * y])


def test_a_couple_walks_side_by_side() -> None:
    left, right = network(couples=1).walks
    ahead, aside = in_frame_of(left, right).T
    assert np.abs(ahead).max() < 0.12
    assert (bool(aside.min() > -0.72), bool(aside.max() < -0.52)) == (True, True)


def test_two_people_of_a_couple_differ_in_size() -> None:
    left, right = network(couples=1).walks
    assert np.abs(left.axes - right.axes).max() > 1e-5


def test_couples_keep_clear_of_walls_and_others() -> None:
    office = network(couples=1, count=4)
    assert min(office.floor.clearance(walk.positions).min() for walk in office.walks) > 0.25
    a, b, *others = office.walks
    gaps = [np.linalg.norm(one.positions - other.positions, axis=1).min() for one in (a, b) for other in others]
    assert min(gaps) > 0.5


def test_a_cart_is_ahead_of_who_pushes_it() -> None:
    office = network(carts=1, count=2)
    person, cart = office.bodies[0], office.bodies[1]
    ahead, aside = in_frame_of(person, cart).T
    np.testing.assert_allclose(ahead, 0.95)
    np.testing.assert_allclose(aside, 0, atol=1e-9)
    assert cart.outline is not None
    np.testing.assert_allclose(np.ptp(cart.outline, axis=0), [0.8, 0.5])


def test_a_trolley_has_four_poles() -> None:
    person, *poles = network(trolleys=1, count=1).bodies
    offsets = np.array([in_frame_of(person, pole)[0] for pole in poles])
    assert len(poles) == 4
    np.testing.assert_allclose(np.ptp(offsets, axis=0), [0.7, 0.45])
    assert max(pole.reach for pole in poles) < 0.02


def test_legs_do_not_step_into_the_cart() -> None:
    left, right, cart = network(shape="legs", carts=1, count=1).bodies
    for leg in (left, right):
        assert in_frame_of(cart, leg)[:, 0].max() + leg.reach < -0.4 + 0.02


def test_a_skirt_hides_the_legs_of_the_last_people() -> None:
    bodies = network(shape="legs", skirts=1, count=2).bodies
    assert [body.outline is None for body in bodies] == [False, False, True]
    assert bodies[-1].axes == pytest.approx([0.19, 0.17], rel=0.06)


def test_a_skirt_stays_around_the_person() -> None:
    office = network(shape="legs", skirts=2, count=2)
    off = [
        np.linalg.norm(a.positions - b.positions, axis=1) for a, b in zip(office.walks, office.bodies, strict=True)
    ]
    assert 0.005 < np.median(off) < 0.05


@pytest.mark.parametrize(
    ("people", "message"),
    [
        ({"couples": 2, "count": 3}, "must be at least 4 for these couples"),
        ({"skirts": 1}, "hide legs"),
        ({"couples": 1, "kind": "cylinder"}, "a cylinder has neither company nor carts"),
    ],
)
def test_wrong_numbers_are_errors(people: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PeopleOptions(**people)
