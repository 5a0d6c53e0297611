"""Arms: they swing in antiphase beside the torso, only while one walks, and scanners see them."""

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.simulation import (
    NetworkScenario,
    PeopleOptions,
    ScannerOptions,
    build_network,
    simulate_network_scans,
)
from calgraph.simulation.network_people import add_arms
from calgraph.simulation.network_walks import SimulatedWalk

AXES = np.array([0.25, 0.15])
SWING = 0.2


def straight(speed: float, seconds: float = 10.0) -> SimulatedWalk:
    """Along x."""
    count = round(100 * seconds) + 1
    return SimulatedWalk(
        AXES, 0.0, np.column_stack([0.01 * speed * np.arange(count), np.zeros(count)]), np.zeros(count)
    )


def forward_offset(walk: SimulatedWalk, side: int) -> Array:
    """(K,) how far the left (1) or right (2) arm is before its torso."""
    return np.asarray(add_arms(walk, SWING)[side].positions[:, 0] - walk.positions[:, 0])


def test_without_swing_there_is_only_the_torso() -> None:
    walk = straight(1.2)
    assert add_arms(walk, 0.0) == (walk,)


def test_arms_swing_by_the_stated_amplitude() -> None:
    # The twist of the shoulders takes another 1.5 cm along the way with it.
    assert np.ptp(forward_offset(straight(1.2), 1)) / 2 == pytest.approx(SWING, abs=0.02)


def test_arms_swing_in_antiphase() -> None:
    left, right = (forward_offset(straight(1.2), side) for side in (1, 2))
    np.testing.assert_allclose(left, -right, atol=1e-12)


def test_arms_swing_with_every_stride() -> None:
    left = forward_offset(straight(1.2, 20.0), 1)
    spectrum = np.abs(np.fft.rfft(left - left.mean()))
    assert np.fft.rfftfreq(len(left), 0.01)[np.argmax(spectrum)] == pytest.approx(0.9, abs=0.06)


def test_arms_rest_while_standing() -> None:
    assert np.abs(forward_offset(straight(0.0), 1)).max() == 0.0


def test_arms_are_on_their_sides() -> None:
    _, left, right = add_arms(straight(1.2), SWING)
    assert (left.positions[:, 1].min() > 0.2, right.positions[:, 1].max() < -0.2) == (True, True)


def test_shoulders_turn_by_a_few_degrees() -> None:
    torso, _, _ = add_arms(straight(1.2), SWING)
    assert np.degrees(np.abs(torso.headings).max()) == pytest.approx(3.4, abs=0.2)


def test_arms_do_not_reach_into_walls() -> None:
    network = build_network(NetworkScenario(people=PeopleOptions(count=4), duration=30.0), 1)
    arms = [arm for walk in network.walks for arm in add_arms(walk, SWING)[1:]]
    assert min(float(network.floor.clearance(arm.positions[::10]).min()) for arm in arms) > 0.06


def test_swing_does_not_change_the_walk() -> None:
    still, swinging = (
        build_network(NetworkScenario(people=PeopleOptions(swing=swing), duration=5.0), 3)
        for swing in (0.0, SWING)
    )
    np.testing.assert_array_equal(still.walks[0].positions, swinging.walks[0].positions)


def test_beams_hit_arms_before_the_torso() -> None:
    exact = ScannerOptions(range_noise=0, quantisation=0, mixed_pixels=0, dropout=0)
    still, swinging = (
        simulate_network_scans(
            NetworkScenario(scanner=exact, people=PeopleOptions(swing=swing), duration=5.0, layout="lab"), 3
        )[0]
        for swing in (0.0, SWING)
    )
    nearer = np.concatenate(
        [a.ranges - b.ranges for name in still for a, b in zip(still[name], swinging[name], strict=True)]
    )
    assert np.nanmax(nearer) > 0.15


def test_cylinders_have_no_arms() -> None:
    with pytest.raises(ValueError, match="a cylinder has no arms"):
        PeopleOptions(kind="cylinder", swing=0.1)


def test_shoulders_turn_away_from_the_arm_in_front() -> None:
    walk = straight(1.2)
    torso, *_ = add_arms(walk, SWING)
    forward = forward_offset(walk, 1)
    assert np.corrcoef(torso.headings - walk.headings, forward)[0, 1] == pytest.approx(-1, abs=0.02)
