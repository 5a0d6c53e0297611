"""Arms: they swing in antiphase beside the torso, only while one walks, and scanners see them."""

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.simulation import NetworkScenario, PeopleKnobs, ScannerKnobs, build_network, simulate_network_scans
from calgraph.simulation.network_arms import with_arms
from calgraph.simulation.network_walks import Walk

AXES = np.array([0.25, 0.15])
SWING = 0.2


def straight(speed: float, seconds: float = 10.0) -> Walk:
    """Along x."""
    count = round(100 * seconds) + 1
    return Walk(AXES, 0.0, np.column_stack([0.01 * speed * np.arange(count), np.zeros(count)]), np.zeros(count))


def forth(walk: Walk, side: int) -> Array:
    """(K,) how far the left (1) or right (2) arm is before its torso."""
    return np.asarray(with_arms(walk, SWING)[side].places[:, 0] - walk.places[:, 0])


def test_who_does_not_swing_is_the_torso_alone() -> None:
    walk = straight(1.2)
    assert with_arms(walk, 0.0) == (walk,)


def test_arms_swing_as_far_as_asked_for() -> None:
    # The twist of the shoulders takes another 1.5 cm along the way with it.
    assert np.ptp(forth(straight(1.2), 1)) / 2 == pytest.approx(SWING, abs=0.02)


def test_arms_swing_in_antiphase() -> None:
    left, right = (forth(straight(1.2), side) for side in (1, 2))
    np.testing.assert_allclose(left, -right, atol=1e-12)


def test_arms_swing_with_every_stride() -> None:
    left = forth(straight(1.2, 20.0), 1)
    spectrum = np.abs(np.fft.rfft(left - left.mean()))
    assert np.fft.rfftfreq(len(left), 0.01)[np.argmax(spectrum)] == pytest.approx(0.9, abs=0.06)


def test_arms_hang_where_one_stands() -> None:
    assert np.abs(forth(straight(0.0), 1)).max() == 0.0


def test_arms_are_on_their_sides() -> None:
    _, left, right = with_arms(straight(1.2), SWING)
    assert (left.places[:, 1].min() > 0.2, right.places[:, 1].max() < -0.2) == (True, True)


def test_shoulders_turn_by_a_few_degrees() -> None:
    torso, _, _ = with_arms(straight(1.2), SWING)
    assert np.degrees(np.abs(torso.headings).max()) == pytest.approx(3.4, abs=0.2)


def test_arms_do_not_reach_into_walls() -> None:
    network = build_network(NetworkScenario(people=PeopleKnobs(count=4), duration=30.0), 1)
    arms = [arm for walk in network.walks for arm in with_arms(walk, SWING)[1:]]
    assert min(float(network.floor.clearance(arm.places[::10]).min()) for arm in arms) > 0.06


def test_who_swings_walks_as_who_does_not() -> None:
    still, swinging = (
        build_network(NetworkScenario(people=PeopleKnobs(swing=swing), duration=5.0), 3) for swing in (0.0, SWING)
    )
    np.testing.assert_array_equal(still.walks[0].places, swinging.walks[0].places)


def test_scanners_see_arms_before_the_torso() -> None:
    exact = ScannerKnobs(range_noise=0, quantisation=0, mixed_pixels=0, dropout=0)
    still, swinging = (
        simulate_network_scans(
            NetworkScenario(scanner=exact, people=PeopleKnobs(swing=swing), duration=5.0, layout="lab"), 3
        )[0]
        for swing in (0.0, SWING)
    )
    nearer = np.concatenate(
        [a.ranges - b.ranges for name in still for a, b in zip(still[name], swinging[name], strict=True)]
    )
    assert np.nanmax(nearer) > 0.15


def test_cylinders_have_no_arms() -> None:
    with pytest.raises(ValueError, match="a cylinder has no arms"):
        PeopleKnobs(kind="cylinder", swing=0.1)
