"""Legs: feet rest and swing beside the path, shins are not round, and scanners observe two of them."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from calgraph.geometry import Array, se3
from calgraph.simulation import (
    NetworkScenario,
    PeopleOptions,
    ScannerOptions,
    SimulatedNetwork,
    build_network,
    simulate_network_scans,
)
from calgraph.simulation.network_people import Gait, add_legs, draw_gait, leg_size, shin_outline
from calgraph.simulation.network_walks import SimulatedWalk

GAIT = Gait(step_length=0.68, foot_offset=0.08, toe_out=0.1, radii=(0.058, 0.066), squareness=2.5)
LEGS = PeopleOptions(shape="legs")
EXACT = ScannerOptions(range_noise=0, quantisation=0, mixed_pixels=0, dropout=0, resolution=0.5)


def straight(speed: float, seconds: float = 20.0) -> SimulatedWalk:
    """Along x."""
    count = round(100 * seconds) + 1
    positions = np.column_stack([0.01 * speed * np.arange(count), np.zeros(count)])
    return SimulatedWalk(np.array([0.25, 0.15]), 0.0, positions, np.zeros(count))


def steady(values: Array) -> Array:
    """Without the first steps, and without the last ones, which have no goal."""
    return values[300:-300]


def speeds(walk: SimulatedWalk) -> Array:
    return np.asarray(np.linalg.norm(np.gradient(walk.positions, 0.01, axis=0), axis=1))


def apart(left: SimulatedWalk, right: SimulatedWalk) -> Array:
    return np.asarray(np.linalg.norm(left.positions - right.positions, axis=1))


def corners(leg: SimulatedWalk, sample: int) -> Array:
    """(L, 2) of its outline in the world."""
    c, s = np.cos(leg.headings[sample]), np.sin(leg.headings[sample])
    assert leg.outline is not None
    return np.asarray(leg.positions[sample] + leg.outline @ np.array([[c, s], [-s, c]]))


@pytest.fixture(scope="module")
def office() -> SimulatedNetwork:
    return build_network(NetworkScenario(people=LEGS), 1)


def pairs_of_legs(network: SimulatedNetwork) -> list[tuple[SimulatedWalk, SimulatedWalk]]:
    return list(zip(network.bodies[::2], network.bodies[1::2], strict=True))


def test_an_ankle_rests_for_about_40_percent_of_a_stride() -> None:
    left, _ = add_legs(straight(1.2), GAIT, 0.1)
    assert np.mean(steady(speeds(left)) < 0.1) == pytest.approx(0.45, abs=0.07)


def test_a_shin_in_stance_moves_at_a_third_of_the_walk() -> None:
    left, _ = add_legs(straight(1.2), GAIT, 0.3)
    assert np.percentile(steady(speeds(left)), 20) / 1.2 == pytest.approx(0.36, abs=0.08)


def test_a_swinging_shin_is_twice_as_fast_as_the_walk() -> None:
    left, _ = add_legs(straight(1.2), GAIT, 0.3)
    assert 1.8 < steady(speeds(left)).max() / 1.2 < 3.0


@pytest.mark.parametrize(("speed", "length"), [(1.2, 0.68), (0.6, 0.68 / np.sqrt(2))])
def test_steps_are_as_long_as_stated_and_shorter_at_lower_speed(speed: float, length: float) -> None:
    left, right = add_legs(straight(speed), GAIT, 0.1)
    ahead = steady(left.positions[:, 0] - right.positions[:, 0])
    crossings = np.flatnonzero(np.diff(np.sign(ahead)))
    assert speed * 0.01 * np.median(np.diff(crossings)) == pytest.approx(length, rel=0.04)


def test_feet_are_beside_the_path() -> None:
    left, right = add_legs(straight(1.2), GAIT, 0.3)
    assert [np.median(left.positions[:, 1]), np.median(right.positions[:, 1])] == pytest.approx([0.08, -0.08])


def test_legs_stay_with_the_pelvis() -> None:
    walk = straight(1.2)
    left, right = add_legs(walk, GAIT, 0.3)
    middle = (left.positions + right.positions) / 2 - walk.positions
    assert np.abs(steady(middle)).max() < 0.1


def test_higher_up_legs_are_nearer_to_each_other() -> None:
    reaches = [steady(apart(*add_legs(straight(1.2), GAIT, height))).max() for height in (0.1, 0.3, 0.5, 0.7)]
    assert all(a > b for a, b in pairwise(reaches))


@pytest.mark.parametrize("stop", [5.0, 5.15, 5.3, 5.45])
def test_feet_are_side_by_side_in_a_stop(stop: float) -> None:
    walk = straight(1.2)
    # Slows down within half a second, and stands for the rest.
    speed = 1.2 * np.clip((stop - 0.01 * np.arange(len(walk.positions))) / 0.5 + 1, 0, 1)
    stopped = replace(walk, positions=np.column_stack([0.01 * np.cumsum(speed), np.zeros(len(speed))]))
    left, right = add_legs(stopped, GAIT, 0.3)
    rest = round(100 * (stop + 2.0))
    assert apart(left, right)[rest:] == pytest.approx(0.16, abs=0.02)
    assert max(speeds(left)[rest:].max(), speeds(right)[rest:].max()) == 0


def test_legs_do_not_run_through_each_other(office: SimulatedNetwork) -> None:
    for left, right in pairs_of_legs(office):
        assert apart(left, right).min() > 1.9 * left.axes[0]


def test_legs_do_not_reach_into_walls(office: SimulatedNetwork) -> None:
    outlines = [corners(leg, sample) for leg in office.bodies for sample in range(0, 6000, 20)]
    assert office.floor.clearance(np.concatenate(outlines)).min() > 0


def test_a_shin_is_deeper_than_wide_with_a_flat_front() -> None:
    outline = shin_outline(0.058, 0.066, 2.5)
    width, depth = np.ptp(outline[:, 1]), np.ptp(outline[:, 0])
    flat = outline[outline[:, 0] > outline[:, 0].max() - 1e-9]
    assert (width / 2, depth / 2) == pytest.approx((0.058, 0.066), abs=1e-3)
    assert np.ptp(flat[:, 1]) > 0.04


def test_a_shin_is_neither_a_circle_nor_a_circle_with_a_second_harmonic() -> None:
    outline = shin_outline(0.058, 0.066, 2.5)
    angle, radius = np.arctan2(outline[:, 1], outline[:, 0]), np.linalg.norm(outline, axis=1)
    model = np.column_stack([np.ones_like(angle), np.cos(2 * angle)])
    residual = radius - model @ np.linalg.lstsq(model, radius, rcond=None)[0]
    assert residual.std() > 0.002


@pytest.mark.parametrize("squareness", [2.0, 2.5, 6.0])
def test_outlines_are_convex(squareness: float) -> None:
    outline = shin_outline(0.058, 0.066, squareness)
    sides = np.diff(outline, axis=0, append=outline[:1])
    turn = sides[:, 0] * np.roll(sides[:, 1], -1) - sides[:, 1] * np.roll(sides[:, 0], -1)
    assert turn.min() > -1e-12


def test_the_calf_is_thicker_than_the_ankle() -> None:
    assert leg_size(0.1) < 0.7 * leg_size(0.33)


def test_legs_turn_with_the_walk(office: SimulatedNetwork) -> None:
    for walk, (left, right) in zip(office.walks, pairs_of_legs(office), strict=True):
        off = (left.headings + right.headings) / 2 - walk.headings
        assert np.median(np.abs(off)) < 0.1


def test_people_differ_in_size_and_stance() -> None:
    gaits = [draw_gait(LEGS, np.random.default_rng(seed)) for seed in range(50)]
    widths, offsets = np.array([g.radii[0] for g in gaits]), np.array([g.foot_offset for g in gaits])
    assert (bool(np.ptp(widths) > 0.015), bool(np.abs(widths / 0.058 - 1).max() <= 0.15)) == (True, True)
    assert (bool(offsets.min() >= 0.06), bool(offsets.max() <= 0.1)) == (True, True)


def test_legs_do_not_change_the_walk(office: SimulatedNetwork) -> None:
    np.testing.assert_array_equal(
        office.walks[0].positions, build_network(NetworkScenario(), 1).walks[0].positions
    )


def count_clusters(points: Array, gap: float = 0.1) -> int:
    """Of neighbouring beams that are nearer than ``gap``."""
    return 1 + int((np.linalg.norm(np.diff(points, axis=0), axis=1) > gap).sum())


def test_a_scanner_at_3_metres_observes_two_clusters_most_of_the_time() -> None:
    people = PeopleOptions(shape="legs", count=1, stop_every=0.0)
    scenario = NetworkScenario(duration=20.0, scanner=EXACT, people=people, clutter=0)
    scans, truth = simulate_network_scans(scenario, 3)
    empty, _ = simulate_network_scans(scenario.model_copy(update={"people": PeopleOptions(count=0)}), 3)
    [person] = truth.people
    counts: list[int] = []
    for name, sent in scans.items():
        for scan, background in zip(sent, empty[name], strict=True):
            hit: NDArray[np.bool_] = scan.ranges < background.ranges - 1e-6
            place = [np.interp(scan.stamp, person.times, person.positions[:, k]) for k in (0, 1)]
            distance = np.linalg.norm(truth.T_root_sensor[name][:2, 3] - place)
            if hit.any() and 2 < distance < 4:
                counts.append(count_clusters(se3.apply(truth.T_root_sensor[name], scan.points)[hit]))
    assert np.mean(np.array(counts) == 2) > 0.6
    assert max(counts) == 2


def test_cylinders_have_no_legs() -> None:
    with pytest.raises(ValueError, match="a cylinder has no legs"):
        PeopleOptions(kind="cylinder", shape="legs")


def test_legs_have_no_arms() -> None:
    with pytest.raises(ValueError, match="arms swing above the legs"):
        PeopleOptions(shape="legs", swing=0.1)


def test_the_range_of_foot_offsets_is_in_order() -> None:
    with pytest.raises(ValueError, match="must be lower, upper"):
        PeopleOptions(foot_offset=(0.1, 0.05))
