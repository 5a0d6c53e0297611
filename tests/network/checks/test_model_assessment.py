"""What the tests of a joint solution leave of it: a wider covariance, or the averaged pairs in its place."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from calgraph.geometry import Array, se2
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.network.checks.consistency_tests import Scatter
from calgraph.network.checks.model_assessment import (
    CORRELATED_BEAMS,
    DIFFERENCE,
    ModelAssessment,
    add_position_errors,
    assess_network_model,
)
from calgraph.network.graph.network_initialization import NetworkInitialization
from calgraph.network.joint.ellipses import EllipseObservations
from calgraph.network.joint.estimate import NetworkSolution
from calgraph.network.joint.planar_poses import NearCovariances
from calgraph.network.joint.problem import BodyScans
from calgraph.network.joint.range_noise import MAX_EXCESS
from calgraph.network.joint.solver import NetworkEquations, linearize_network
from calgraph.network.tracking.track import ScannerTracks
from calgraph.result import ErrorSource
from dense_covariances import relate_all
from leg_scenes import build_network
from network_scenes import OFFSET, SIGMA, T_ROOT
from solved_networks import no_change, solve_two_walks

NAMES = ("west", "east", "north")
TRACKED = [ScannerTracks((), np.zeros((0, 2)), SIGMA)] * 3
EDGES = np.array([[0, 1], [0, 2]])
PAIR_SIGMA = 0.02
"""Of averaged poses, m and rad."""


@cache
def solve(alternating: bool = False) -> NetworkEquations:
    """The solution of a right recording, or of one in which errors change every five seconds."""

    def alternate(_body: int, scans: BodyScans) -> BodyScans:
        when = (np.floor(scans.times / 5) % 2 == 1) & (scans.scanner == 1)
        R = se2.pose(0.005, np.zeros(2))[:2, :2]
        turned = np.repeat(when, np.diff(scans.first_beam, append=len(scans.ranges)))[:, None]
        return replace(scans, direction=np.where(turned, scans.direction @ R.T, scans.direction))

    return solve_two_walks(np.random.default_rng(0), alternate if alternating else no_change)


def with_noise_at_limit(solved: NetworkEquations | None = None) -> NetworkEquations:
    limit, solved = np.hypot(SIGMA, MAX_EXCESS), solved or solve()
    return replace(solved, network=replace(solved.network, range_sigma=np.full(3, limit)))


def with_other_radii(solved: NetworkEquations, radii: tuple[float, float]) -> NetworkEquations:
    """The solution of which rig.yaml states other radii, m."""
    bodies = [one for one in solved.network.bodies if isinstance(one, EllipseObservations)]
    stated = tuple(replace(one, radii=np.array(radii)) for one in bodies)
    return replace(solved, network=replace(solved.network, bodies=stated))


JOINT = relate_all(1e-6 * np.eye(12), 3)


def assess(
    solved: NetworkEquations | None,
    averaging_error: float = 0.0,
    *,
    replaceable: bool = True,
    covariance: NearCovariances = JOINT,
) -> ModelAssessment:
    """With averaged poses of which the last is off by ``averaging_error``, m."""
    joint = NetworkSolution(T_ROOT, OFFSET, covariance, solved)
    averaged = T_ROOT.copy()
    averaged[2, 0, 2] += averaging_error
    T_i_j = np.array([se2.inverse(averaged[i]) @ averaged[j] for i, j in EDGES])
    graph = PoseGraph(3, EDGES, T_i_j, np.tile(np.eye(3) / PAIR_SIGMA**2, (2, 1, 1)))
    return assess_network_model(
        joint,
        TRACKED,
        NetworkInitialization({}, graph, NAMES, PoseGraphSolution(averaged, np.array([True, True]))),
        replaceable=replaceable,
    )


def covariance_of(assessment: ModelAssessment) -> Array:
    assert assessment.joint is not None
    return assessment.joint.covariance.expand()


def test_a_right_solution_stays_as_it_is() -> None:
    found = assess(solve())
    assert found.findings == ()
    np.testing.assert_array_equal(covariance_of(found), 1e-6 * np.eye(12))


def test_errors_of_outlines_add_to_position_variances() -> None:
    """Of the root to those of all, 2 mm; of north alone 4 mm; other variances grow in proportion."""
    joint = NetworkSolution(T_ROOT, OFFSET, relate_all(1e-6 * np.eye(12), 3))
    widened = add_position_errors(joint, np.array([0.002, 0.0, 0.004])).covariance.stddev ** 2
    np.testing.assert_allclose(widened, np.repeat([[1e-6], [5e-6], [21e-6]], 4, axis=1))


def test_correlated_beams_of_another_shape_widen_the_covariance(monkeypatch: pytest.MonkeyPatch) -> None:
    module = "calgraph.network.checks.model_assessment"
    monkeypatch.setattr(f"{module}.correlate_adjacent_beams", lambda _: np.array([0.0, 0.0, 0.8]))
    monkeypatch.setattr(f"{module}.measure_scatter", lambda _: Scatter(1.0, 1.0))
    noisy = replace(solve(), network=replace(solve().network, range_sigma=SIGMA * np.array([1, 1, 3])))
    found = assess(noisy)
    (finding,) = found.findings
    assert "north at people have a correlation of 0.80" in finding.text
    added = np.diag(covariance_of(found))[8:10] - 1e-6
    np.testing.assert_allclose(added, 0.8 * 8 * SIGMA**2)


def test_a_solution_without_its_problem_is_not_tested() -> None:
    found = assess(None, averaging_error=1.0)
    assert found.findings == ()
    assert found.joint is not None


def test_a_solution_without_bodies_is_not_tested() -> None:
    problem, state = replace(solve().network, bodies=()), replace(solve().state, paths=())
    nothing = linearize_network(problem, state)
    assert assess(nothing, averaging_error=1.0).findings == ()


def test_a_refuted_solution_is_replaced_and_all_verdicts_state_one_reason() -> None:
    found = assess(with_noise_at_limit())
    assert found.joint is None
    assert found.findings[0].text.startswith("the model of the joint solution does not hold (see the remarks)")
    assert "poses are averages of pairs instead" in found.findings[0].text
    assert [finding.sensors for finding in found.findings] == [NAMES, ()]
    assert "range noise" in found.findings[1].text


def test_a_refuted_solution_that_nothing_can_replace_stays() -> None:
    found = assess(with_noise_at_limit(), replaceable=False)
    assert found.joint is not None
    assert "its poses may be wrong" in found.findings[0].text
    assert found.findings[0].sensors == NAMES


def test_scatter_widens_the_covariance_and_makes_all_poses_weak() -> None:
    found = assess(solve(alternating=True))
    (scatter,) = (one for one in found.findings if "recording to the poses scatter" in one.text)
    assert scatter.sensors == NAMES
    ratio = float(scatter.text.split(" times")[0].split()[-1])
    np.testing.assert_allclose(np.diag(covariance_of(found)), 1e-6 * ratio**2, rtol=0.1)


def test_scatter_that_the_covariance_contains_is_no_reason_for_weak_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.network.checks.model_assessment._MAX_GOOD_SCATTER", 100.0)
    found = assess(solve(alternating=True))
    assert not any("recording to the poses scatter" in one.text for one in found.findings)
    assert covariance_of(found)[0, 0] > 1.5e-6


def test_contradicted_poses_contain_their_difference_from_averaged_pairs() -> None:
    """7 cm of 2 cm, over six axes: the variance of the joint solution is what 2 cm do not explain."""
    found = assess(solve(alternating=True), averaging_error=0.07)
    assert [finding for finding in found.findings if "from averaged pairs" in finding.text] == []
    expected = 0.07**2 / 6 - PAIR_SIGMA**2
    np.testing.assert_allclose(np.diag(covariance_of(found)), expected, rtol=2e-3)
    right = assess(solve(), averaging_error=0.07)
    np.testing.assert_array_equal(covariance_of(right), 1e-6 * np.eye(12))


def test_the_difference_is_a_source_of_its_own_that_no_longer_recording_reduces() -> None:
    joint = assess(solve(alternating=True), averaging_error=0.07).joint
    assert joint is not None
    assert [source for source, _ in joint.variance_factors] == ["scatter of parts", CORRELATED_BEAMS, DIFFERENCE]
    assert ErrorSource(DIFFERENCE).remedy.startswith("stating what scanners measure of people")


def test_a_refuted_solution_that_stays_contains_its_difference_from_averaged_pairs() -> None:
    """Also where averages alone do not contradict it, 7 cm of 2 cm over six axes."""
    found = assess(with_noise_at_limit(), averaging_error=0.07, replaceable=False)
    np.testing.assert_allclose(np.diag(covariance_of(found)), 0.07**2 / 6 - PAIR_SIGMA**2, rtol=2e-3)
    assert found.averaged_variance == 1.0


def test_covariances_of_scanners_that_are_unknown_are_no_part_of_the_difference() -> None:
    """7 cm of 2 cm in one of two poses, as where all are known."""
    known = JOINT.pairs[:, 0] == JOINT.pairs[:, 1]
    near = NearCovariances(3, JOINT.pairs[known], JOINT.blocks[known])
    joint = assess(solve(alternating=True), averaging_error=0.07, covariance=near).joint
    assert joint is not None
    np.testing.assert_allclose(joint.covariance.stddev**2, 0.07**2 / 6 - PAIR_SIGMA**2, rtol=2e-3)


def test_averages_with_wrong_radii_are_no_reason_to_widen_what_scatters() -> None:
    scattered = assess(with_other_radii(solve(alternating=True), (0.18, 0.15)), averaging_error=0.07)
    assert len(scattered.findings) > 0
    assert covariance_of(scattered)[0, 0] < 1e-5


def test_averaged_poses_contain_their_difference_from_the_solution_that_they_replace() -> None:
    """But what the variance of that, 1 cm² of a pose, explains."""
    joint = relate_all(1e-4 * np.eye(12), 3)
    found = assess(with_noise_at_limit(), averaging_error=0.2, covariance=joint)
    assert found.joint is None
    assert found.averaged_variance == pytest.approx((0.2**2 / 6 - 1e-4) / PAIR_SIGMA**2, rel=2e-3)
    assert assess(with_noise_at_limit()).averaged_variance == 1.0
    assert assess(solve()).averaged_variance == 1.0


def test_averages_of_legs_have_the_variance_that_they_are_tested_with() -> None:
    """Twice that of their pairs, of poses that they replace, and in the difference from others."""
    legs = linearize_network(*build_network())
    assert assess(with_noise_at_limit(legs)).averaged_variance == 2.0
    widened = np.diag(covariance_of(assess(legs, averaging_error=0.2, replaceable=False)))
    np.testing.assert_allclose(widened, 0.2**2 / 6 - 2 * PAIR_SIGMA**2, rtol=2e-3)


def test_averaged_pairs_that_disagree_make_all_poses_weak() -> None:
    """Far beyond 3 cm, the standard deviation of the average; variances contain the difference."""
    found = assess(solve(), averaging_error=0.2)
    assert [finding.sensors for finding in found.findings] == [NAMES]
    np.testing.assert_allclose(np.diag(covariance_of(found)), 0.2**2 / 6 - PAIR_SIGMA**2, rtol=2e-3)


def test_parts_and_averaged_pairs_that_both_disagree_refute_the_model() -> None:
    assert assess(solve(alternating=True), averaging_error=0.2).joint is None


def test_averages_are_evidence_against_legs_whatever_their_radii() -> None:
    problem, state = build_network()
    legs = linearize_network(problem, state)
    assert any("from averaged pairs" in finding.text for finding in assess(legs, averaging_error=0.2).findings)


def test_averages_of_legs_may_be_farther_off_than_their_covariance_states() -> None:
    """5.5 standard deviations of 2 cm, of which legs make 28 mm."""
    problem, state = build_network()
    legs = linearize_network(problem, state)
    for solved, disagree in ((legs, False), (solve(), True)):
        found = assess(solved, averaging_error=0.11).findings
        assert any("from averaged pairs" in finding.text for finding in found) is disagree


@pytest.mark.parametrize("axes", [(0.18, 0.15), (0.25, 0.19)])
def test_averages_with_stated_radii_that_are_wrong_are_no_evidence(axes: tuple[float, float]) -> None:
    assert assess(with_other_radii(solve(), axes), averaging_error=0.2).findings == ()
