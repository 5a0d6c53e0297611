"""Findings about parts of a recording that contradict each other, and about averaged pairs that do."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.geometry import se2
from calgraph.network.checks.consistency_tests import (
    compute_p_value,
    find_disagreement,
    find_inconsistent_parts,
    measure_excess,
    measure_scatter,
)
from calgraph.network.checks.model_assessment import _INTERVAL
from calgraph.network.joint.contributions import Contributions, NetworkContributions, split_contributions
from calgraph.network.joint.estimate import NetworkSolution
from calgraph.network.joint.problem import BodyScans
from calgraph.network.joint.solver import linearize_network, optimize_network
from calgraph.result.finding import Finding
from dense_covariances import relate_all
from network_scenes import OFFSET, T_ROOT
from solved_networks import MIDDLE, Change, no_change, solve_two_walks

NAMES = ("west", "east", "north")


def find(change: Change = no_change, seed: int = 0, variance_factor: float = 1.0) -> list[Finding]:
    return list(find_inconsistent_parts(join(split(change, seed)), NAMES, variance_factor))


def join(parts: NetworkContributions) -> Contributions:
    """The parts over all scanners."""
    return parts.select(np.arange(3))


def split(change: Change = no_change, seed: int = 0) -> NetworkContributions:
    return split_contributions(solve_two_walks(np.random.default_rng(seed), change), _INTERVAL)


def turn(scans: BodyScans, angle: float, when: np.ndarray) -> BodyScans:
    """The scans with beams turned by an angle (rad) in some of them (V,)."""
    counts = np.diff(scans.first_beam, append=len(scans.ranges))
    R = se2.pose(angle, np.zeros(2))[:2, :2]
    turned = np.where(np.repeat(when, counts)[:, None], scans.direction @ R.T, scans.direction)
    return replace(scans, direction=turned)


@pytest.mark.parametrize("seed", range(3))
def test_parts_of_a_right_recording_agree(seed: int) -> None:
    assert find(seed=seed) == []


def test_a_scanner_that_turned_gives_halves_that_differ() -> None:
    found = find(lambda _, scans: turn(scans, 0.01, (scans.times > MIDDLE) & (scans.scanner == 1)))
    halves = next(one for one in found if one.text.startswith("the first and the second half"))
    assert "give poses of east that differ by" in halves.text
    # Turned by 0.57°, of which robust weights leave a part.
    angle = float(halves.text.split("°")[0].split()[-1])
    assert angle == pytest.approx(0.4, abs=0.2)
    assert "east" in halves.sensors
    assert not halves.refutes


def test_differences_are_compared_with_the_variance_that_parts_have() -> None:
    def change(_body: int, scans: BodyScans) -> BodyScans:
        return turn(scans, 0.002, (scans.times > MIDDLE) & (scans.scanner == 1))

    assert find(change)
    assert find(change, variance_factor=25.0) == []


def test_a_clock_that_steps_gives_halves_that_differ() -> None:
    found = find(
        lambda _, scans: replace(
            scans, times=scans.times + 0.02 * ((scans.times > MIDDLE) & (scans.scanner == 2)).astype(float)
        )
    )
    assert any(one.text.startswith("the first and the second half") and "north" in one.sensors for one in found)


def test_people_who_give_other_poses_are_found() -> None:
    found = find(
        lambda body, scans: turn(scans, 0.01 * body * (scans.scanner == 1), np.full(len(scans.times), True))
    )
    assert found[0].text.startswith("two groups of people, each over the whole recording, give poses of east")
    assert "east" in found[0].sensors


def test_errors_that_last_for_seconds_scatter_too_much() -> None:
    # Alternating every five seconds, they are the same in both halves and for both people.
    def alternate(_body: int, scans: BodyScans) -> BodyScans:
        return turn(scans, 0.008 * (scans.scanner == 1), np.floor(scans.times / 5) % 2 == 1)

    found = measure_scatter(split(alternate))
    assert found.ratio > 1.5
    assert found.p < 1e-3


@pytest.mark.parametrize("seed", range(3))
def test_white_noise_scatters_as_expected(seed: int) -> None:
    found = measure_scatter(split(seed=seed))
    assert found.ratio == pytest.approx(0.8, abs=0.4)
    assert found.p > 1e-3


def test_one_body_cannot_be_compared_with_another() -> None:
    solved = solve_two_walks(np.random.default_rng(0))
    problem = replace(solved.network, bodies=solved.network.bodies[:1])
    state = replace(solved.state, paths=solved.state.paths[:1])
    one = linearize_network(problem, state)
    parts = join(split_contributions(one, _INTERVAL))
    assert not any("two groups" in found.text for found in find_inconsistent_parts(parts, NAMES, 1.0))


def disagree(error: float, sigma: float) -> list[Finding]:
    """Of averaged poses of which one is off by ``error``, with a standard deviation of ``sigma``, m."""
    covariance = np.zeros((12, 12))
    averaged = T_ROOT.copy()
    averaged[2, 0, 2] += error
    of_averaged = np.zeros((9, 9))
    of_averaged[np.arange(3, 9), np.arange(3, 9)] = sigma**2
    joint = NetworkSolution(T_ROOT, OFFSET, relate_all(covariance, 3))
    return list(find_disagreement(joint, averaged, of_averaged, NAMES))


def test_a_joint_solution_within_the_covariance_of_averaging_agrees() -> None:
    # 4.5 standard deviations along one of six axes: p = 0.0024.
    assert disagree(0.045, 0.01) == []


def test_a_joint_solution_beyond_it_makes_all_poses_weak() -> None:
    (found,) = disagree(0.055, 0.01)
    assert found.text.startswith("the joint solution is up to 55 mm (north) from averaged pairs")
    assert (found.sensors, found.refutes) == (NAMES, False)


def test_p_values_are_those_of_chi_squared() -> None:
    # 5.991 is the 95 % quantile with two degrees of freedom.
    error = np.sqrt(5.991 / 2) * np.array([2.0, 3.0])
    assert compute_p_value(error, np.diag([4.0, 9.0]), 1e-3) == pytest.approx(0.05, abs=1e-4)


def test_directions_without_variance_do_not_count() -> None:
    assert compute_p_value(np.array([1.0, 1.0]), np.ones((2, 2)), 1e-3) == pytest.approx(0.3173, abs=1e-4)


def test_variance_that_is_small_beside_the_scale_is_none() -> None:
    error, covariance = np.array([1.0, 1.0]), np.diag([1.0, 1e-4])
    assert compute_p_value(error, covariance, 1e-3, np.ones(2)) == pytest.approx(0.3173, abs=1e-4)
    assert compute_p_value(error, covariance, 1e-5, np.ones(2)) < 1e-100
    assert compute_p_value(error, covariance, 1e-3) < 1e-100


def test_a_scanner_with_data_in_one_half_is_not_compared() -> None:
    def leave(_body: int, scans: BodyScans) -> BodyScans:
        gone = np.repeat(scans.times > MIDDLE - 2, np.diff(scans.first_beam, append=len(scans.ranges)))
        return replace(scans, weight=np.where(gone & (scans.scanner == 2), 0.0, scans.weight))

    solved = solve_two_walks(np.random.default_rng(0))
    bodies = tuple(
        replace(body, scans=tuple(leave(0, scans) for scans in body.scans)) for body in solved.network.bodies
    )
    network = replace(solved.network, bodies=bodies)
    _, equations = optimize_network(network, solved.state, iterations=6)
    parts = join(split_contributions(equations, _INTERVAL))
    found = find_inconsistent_parts(parts, NAMES, 1.0)
    assert not any("the first and the second half" in one.text for one in found)


def test_an_unknown_without_information_does_not_take_part() -> None:
    error, covariance = np.array([2.0, 0.0]), np.diag([1.0, 0.0])
    assert compute_p_value(error, covariance, 1e-3, np.array([1.0, 0.0])) == pytest.approx(0.0455, abs=1e-4)


def test_without_any_information_nothing_is_unlikely() -> None:
    assert compute_p_value(np.zeros(2), np.zeros((2, 2)), 1e-3, np.zeros(2)) == 1.0


def test_a_difference_that_both_covariances_explain_widens_none() -> None:
    assert measure_excess(np.array([1.0, 1.0]), np.eye(2), np.eye(2)) == 1.0


def test_the_excess_of_a_difference_is_what_makes_it_as_large_as_expected() -> None:
    """4 + 12 over 2 is 8: variances of 1 with 7 of their own; all 8 if the other estimate is exact."""
    difference = np.array([2.0, np.sqrt(12.0)])
    assert measure_excess(difference, np.eye(2), np.eye(2)) == pytest.approx(7.0, rel=2e-3)
    assert measure_excess(difference, np.eye(2), np.zeros((2, 2))) == pytest.approx(8.0, rel=2e-3)


def test_the_excess_is_of_the_first_covariance_alone() -> None:
    """A second component of variance 9 that the other estimate explains takes no part of the excess."""
    difference, other = np.array([3.0, 3.0]), np.diag([0.0, 9.0])
    factor = measure_excess(difference, np.diag([1.0, 1e-9]), other)
    assert factor == pytest.approx(9.0, rel=2e-3)
