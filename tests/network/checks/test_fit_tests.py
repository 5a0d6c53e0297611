"""Findings about the fit of a joint solution: limits, unused beams, and residuals that are correlated."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.network.checks.model_assessment import (
    correlate_adjacent_beams,
    find_correlated_beams,
    find_poor_fit,
    measure_outline_errors,
)
from calgraph.network.joint.model_error import MAX_HEADING_SIGMA, MAX_POSITION_SIGMA
from calgraph.network.joint.problem import BodyScans
from calgraph.network.joint.range_noise import MAX_EXCESS
from calgraph.network.joint.solver import NetworkEquations
from calgraph.result.finding import Finding
from network_scenes import SIGMA
from solved_networks import replace_bodies, solve_two_walks

NAMES = ("west", "east", "north")
BACKGROUND = np.full(3, SIGMA)
NOISE_LIMIT = np.hypot(SIGMA, MAX_EXCESS)


@pytest.fixture(scope="module")
def solved() -> NetworkEquations:
    return solve_two_walks(np.random.default_rng(0))


def find(solved: NetworkEquations) -> list[Finding]:
    return list(find_poor_fit(solved, NAMES, BACKGROUND))


def with_noise(solved: NetworkEquations, sigma: Array) -> NetworkEquations:
    return replace(solved, network=replace(solved.network, range_sigma=sigma))


def with_model_error(solved: NetworkEquations, position: float, heading: float) -> NetworkEquations:
    variance = np.array([position, heading]) ** 2
    return replace(solved, network=replace(solved.network, model_error_variance=variance))


def test_a_right_model_fits(solved: NetworkEquations) -> None:
    assert find(solved) == []


def test_noise_at_its_limit_refutes_the_model_and_makes_its_scanner_weak(solved: NetworkEquations) -> None:
    (found,) = find(with_noise(solved, np.array([SIGMA, NOISE_LIMIT, SIGMA])))
    assert found.text.startswith("the range noise of east at people is at its limit, 5 times that at walls")
    assert (found.sensors, found.refutes) == (("east",), True)


def test_noise_of_the_root_at_its_limit_makes_all_scanners_weak(solved: NetworkEquations) -> None:
    (found,) = find(with_noise(solved, np.array([NOISE_LIMIT, SIGMA, SIGMA])))
    assert found.sensors == NAMES


def test_a_position_error_at_its_limit_refutes_the_model(solved: NetworkEquations) -> None:
    (found,) = find(with_model_error(solved, MAX_POSITION_SIGMA, 0.1))
    assert found.text.startswith("scanners disagree about people by 100 mm in each scan")
    assert (found.sensors, found.refutes) == (NAMES, True)


def test_a_heading_error_at_its_limit_does_not_refute_the_model(solved: NetworkEquations) -> None:
    (found,) = find(with_model_error(solved, 0.001, MAX_HEADING_SIGMA))
    assert found.text.startswith("scanners disagree about people by 29° in each scan")
    assert (found.sensors, found.refutes) == (NAMES, False)


def test_a_scanner_of_whose_beams_few_have_a_weight_is_weak(solved: NetworkEquations) -> None:
    def drop_half(scans: BodyScans) -> BodyScans:
        kept = np.arange(len(scans.weight)) % 2 == 0
        return replace(scans, weight=scans.weight * (kept | (scans.scanner != 2)))

    bodies = tuple(
        replace(body, scans=tuple(drop_half(scans) for scans in body.scans)) for body in solved.network.bodies
    )
    (found,) = find(replace_bodies(solved, bodies))
    assert found.text.startswith("only 4")
    assert "beams of north at people agree" in found.text
    assert (found.sensors, found.refutes) == (("north",), False)


def test_bodies_of_another_shape_give_correlated_residuals() -> None:
    rng = np.random.default_rng(1)

    def fold(_body: int, scans: BodyScans) -> BodyScans:
        # Folds as wide as half of the nine beams of a scan.
        folds = np.repeat(rng.normal(0, 0.02, (len(scans.ranges) // 9, 2)), [4, 5], axis=1)
        return replace(scans, ranges=scans.ranges + folds.ravel())

    solved = solve_two_walks(rng, fold)
    assert np.all(correlate_adjacent_beams(solved) > 0.15)


CORRELATION = np.array([0.1, 0.5, 0.3])


def test_correlated_beams_make_poses_weak_whose_error_exceeds_the_tolerance() -> None:
    errors = np.array([0.0, 0.006, 0.003])
    for limit, weak in ((0.007, ()), (0.005, ("east",)), (0.002, ("east", "north"))):
        (found,) = find_correlated_beams(NAMES, CORRELATION, errors, limit)
        assert found.text.startswith(
            "residuals of adjacent beams of east, north at people have a correlation of 0.50, for which up to "
            "6.0 mm are added to the standard deviations of positions: people are of another shape"
        )
        assert (found.sensors, found.refutes) == (weak, False)
    (of_root,) = find_correlated_beams(NAMES, CORRELATION[::-1], errors[::-1], 0.002)
    assert of_root.sensors == NAMES
    assert list(find_correlated_beams(NAMES, np.full(3, 0.1), np.zeros(3), 0.002)) == []


def test_correlated_noise_that_walls_have_as_well_is_no_error_of_the_outline(solved: NetworkEquations) -> None:
    noisy = with_noise(solved, SIGMA * np.array([2, 0.9, 2]))
    errors = measure_outline_errors(noisy, BACKGROUND, CORRELATION)
    np.testing.assert_allclose(errors, [0, 0, np.sqrt(0.3 * 3) * SIGMA])
    (found,) = find_correlated_beams(NAMES, CORRELATION, np.zeros(3), 0.002)
    assert found.text.endswith("0.50, with no more noise than at walls: standard deviations contain it")
    assert found.sensors == ()


def test_residuals_of_white_noise_are_not_correlated(solved: NetworkEquations) -> None:
    np.testing.assert_array_less(np.abs(correlate_adjacent_beams(solved)), 0.12)


def test_beams_of_different_scans_are_not_adjacent(solved: NetworkEquations) -> None:
    # One beam a scan: there are no adjacent ones.
    bodies = tuple(
        replace(
            body,
            scans=tuple(
                replace(scans, weight=scans.weight * (np.arange(len(scans.weight)) % 9 == 0))
                for scans in body.scans
            ),
        )
        for body in solved.network.bodies
    )
    alone = replace_bodies(solved, bodies)
    np.testing.assert_array_equal(correlate_adjacent_beams(alone), 0)
