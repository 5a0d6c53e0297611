"""Estimates of pairs: refinement, ambiguity, information, and the inverse."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.config.settings import BoardPairSettings
from calgraph.geometry import Array, se3, so3
from calgraph.graph.pairwise_estimate import (
    Linearization,
    PairwiseEstimate,
    compute_information,
    compute_normalized_rms,
    linearize_at,
    refine_pose,
    resolve_ambiguity,
    select_matches,
    squared_residual_function,
)

DIRECTIONS = np.eye(6)


class DirectionMatches:
    """Each match measures one direction of the tangent space, with a given value, variance and gain."""

    sample_size = 6

    def __init__(self, directions: Array, values: Array, variances: Array, feasible: bool = True) -> None:
        self.directions, self.values, self.variances, self._feasible = directions, values, variances, feasible

    def solve(self, samples: np.ndarray[tuple[int, ...], np.dtype[np.intp]]) -> Array:
        raise NotImplementedError

    def linearize(self, T_a_b: Array) -> Linearization:
        r = se3.difference(T_a_b, np.eye(4)) @ self.directions.T - self.values
        K, M = r.shape
        J = np.zeros((K, M, 1, 6))
        J[:, :, 0] = self.directions
        covariance = np.broadcast_to(self.variances[:, None, None], (K, M, 1, 1))
        return Linearization(r[..., None], J, covariance)

    def feasible(self, T_a_b: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        return np.full((len(T_a_b), len(self.values)), self._feasible)


def test_squared_residuals_are_over_the_gate_and_the_model_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.graph.pairwise_estimate._INLIER_GATE", 2.0)
    monkeypatch.setattr("calgraph.graph.pairwise_estimate.MODEL_ERROR", 0.01)
    matches = DirectionMatches(DIRECTIONS, np.array([0.05, 0, 0, 0, 0, 0]), np.full(6, 0.02**2))
    r2 = squared_residual_function(matches)(np.eye(4)[None])
    np.testing.assert_allclose(r2[0, :2], [0.05**2 / (0.02**2 + 0.01**2) / 4, 0.0])


def test_infeasible_matches_are_never_inliers() -> None:
    matches = DirectionMatches(DIRECTIONS, np.zeros(6), np.ones(6), feasible=False)
    assert np.isinf(squared_residual_function(matches)(np.eye(4)[None])).all()


def test_refinement_weights_inliers_by_their_covariances() -> None:
    # x is measured as 0.1 m and 0.2 m, the second with twice the standard deviation; the third is no inlier.
    directions = DIRECTIONS[[0, 0, 0, 1, 2, 3, 4, 5]]
    values = np.array([0.1, 0.2, 9.0, 0, 0, 0, 0, 0])
    matches = DirectionMatches(directions, values, np.array([1, 4, 1, 1, 1, 1, 1, 1]) * 1e-4)
    inliers = np.array([True, True, False, True, True, True, True, True])
    T = refine_pose(np.eye(4), matches, inliers, 1e-9, BoardPairSettings())
    np.testing.assert_allclose(se3.difference(T, np.eye(4)), [0.12, 0, 0, 0, 0, 0], atol=1e-7)


@pytest.mark.parametrize(("stddev", "moved"), [(0.09, 0.05), (0.11, 0.0)])
def test_refinement_does_not_move_uncertain_directions(stddev: float, moved: float) -> None:
    matches = DirectionMatches(DIRECTIONS, np.array([0.05, 0, 0, 0, 0, 0]), np.array([stddev, *[0.01] * 5]) ** 2)
    T = refine_pose(np.eye(4), matches, np.ones(6, dtype=bool), 0.001, BoardPairSettings())
    assert T[0, 3] == pytest.approx(moved, abs=1e-4)


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_information_is_divided_by_a_reduced_chi_squared_above_one(scale: float) -> None:
    directions = np.tile(DIRECTIONS, (2, 1))
    signs = np.repeat([1.0, -1.0], 6)
    # Reduced chi-squared: 12 (scale * 0.01)^2 / 0.01^2 / (12 - 6).
    matches = DirectionMatches(directions, signs * scale * 0.01, np.full(12, 0.01**2))
    at = matches.linearize(np.eye(4)[None])
    at = Linearization(at.residuals[0], at.jacobian[0], at.covariance[0])
    found = compute_information(at, np.ones(12, dtype=bool))
    np.testing.assert_allclose(found, 2 / 0.01**2 / (2 * scale**2) * np.eye(6), rtol=1e-3)
    assert compute_normalized_rms(at, np.ones(12, dtype=bool), 1e-9) == pytest.approx(np.sqrt(2) * scale)


def test_information_of_small_residuals_is_not_increased() -> None:
    matches = DirectionMatches(np.tile(DIRECTIONS, (2, 1)), np.zeros(12), np.full(12, 0.01**2))
    at = matches.linearize(np.eye(4)[None])
    at = Linearization(at.residuals[0], at.jacobian[0], at.covariance[0])
    np.testing.assert_allclose(compute_information(at, np.ones(12, dtype=bool)), 2e4 * np.eye(6), rtol=1e-3)


@pytest.mark.parametrize(("flatness", "expected"), [(1e-9, 1.0), (0.01, np.sqrt(0.5)), (0.02, np.sqrt(0.2))])
def test_normalized_rms_allows_for_the_flatness_of_the_board(flatness: float, expected: float) -> None:
    # 12 residuals of 1 cm with a standard deviation of 1 cm have a chi-squared of 12, over 6 degrees of freedom.
    matches = DirectionMatches(np.tile(DIRECTIONS, (2, 1)), np.full(12, 0.01), np.full(12, 0.01**2))
    found = compute_normalized_rms(linearize_at(np.eye(4), matches), np.ones(12, dtype=bool), flatness)
    assert found == pytest.approx(np.sqrt(2) * expected)


def turned(degrees: float) -> Array:
    return se3.pose(so3.exp(np.array([np.radians(degrees), 0, 0])), np.zeros(3))


@pytest.mark.parametrize(("degrees", "stddev", "expected"), [
    (90.0, 0.6, 90.0), (90.0, 0.4, 0.0), (5.5, 0.6, 5.5), (4.5, 0.6, 0.0),
])  # fmt: skip
def test_another_pose_that_fits_equally_well_is_ambiguous(
    degrees: float, stddev: float, expected: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calgraph.graph.pairwise_estimate.FLATNESS", 1e-9)
    # chi-squared of the other pose: (angle / stddev)^2, against a margin of 12; 90 degrees are 1.57 rad.
    gain = 1.57 / np.radians(degrees) / stddev * 1.3
    matches = DirectionMatches(gain * DIRECTIONS, np.zeros(6), np.ones(6))
    T, angle = resolve_ambiguity(np.eye(4), turned(degrees)[None], matches, np.ones(6, dtype=bool))
    np.testing.assert_allclose(T, np.eye(4))
    assert np.degrees(angle) == pytest.approx(expected)


def test_a_pose_that_fits_clearly_better_is_selected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.graph.pairwise_estimate.FLATNESS", 1e-9)
    matches = DirectionMatches(DIRECTIONS, np.array([0, 0, 0, np.radians(30), 0, 0]), np.full(6, 0.01**2))
    others = np.array([turned(20.0), turned(30.0)])
    T, angle = resolve_ambiguity(np.eye(4), others, matches, np.ones(6, dtype=bool))
    np.testing.assert_allclose(T, turned(30.0))
    assert angle == 0.0


def build_estimate(rng: np.random.Generator) -> PairwiseEstimate:
    T_a_b = se3.pose(so3.exp(np.array([0.4, -1.0, 0.3])), np.array([1.0, -2.0, 0.5]))
    A = rng.normal(size=(6, 6))
    table = np.array([[3, 0, 1], [4, 1, 0], [5, 0, 0]])
    inliers = np.array([True, False, True])
    return PairwiseEstimate("a", "b", T_a_b, A @ A.T, table, inliers, np.array([0.1, 9.0, 0.2]), 0.3, 1.7)


def test_inverse_has_the_transported_information(rng: np.random.Generator) -> None:
    estimate = build_estimate(rng)
    inverse = estimate.inverse()
    covariance = np.asarray(np.linalg.inv(estimate.information), dtype=np.float64)
    expected = se3.inverse_covariance(estimate.T_a_b, covariance)
    np.testing.assert_allclose(np.linalg.inv(inverse.information), expected, rtol=1e-6)
    np.testing.assert_allclose(inverse.T_a_b @ estimate.T_a_b, np.eye(4), atol=1e-12)
    assert (inverse.sensor_a, inverse.sensor_b) == ("b", "a")
    assert inverse.matches.tolist() == [[3, 1, 0], [4, 0, 1], [5, 0, 0]]
    assert (inverse.alternative_pose_angle, inverse.normalized_rms) == (0.3, 1.7)


def test_squared_error_is_that_of_the_inliers(rng: np.random.Generator) -> None:
    assert build_estimate(rng).squared_error == pytest.approx(0.1**2 + 0.2**2)


def test_matches_of_the_joint_solution_are_inliers_or_first_candidates(rng: np.random.Generator) -> None:
    estimate = replace(build_estimate(rng), inliers=np.array([True, False, False]))
    assert select_matches(estimate, "ransac").tolist() == [True, False, False]
    assert select_matches(estimate, "none").tolist() == [False, False, True]


def test_as_many_residuals_as_unknowns_count_as_one_degree_of_freedom() -> None:
    matches = DirectionMatches(DIRECTIONS, np.full(6, 0.02), np.full(6, 0.01**2))
    rms = compute_normalized_rms(linearize_at(np.eye(4), matches), np.ones(6, dtype=bool), 0.0)
    assert rms == pytest.approx(np.sqrt(6 * 2.0**2))
