"""Extrapolated normal equations against exact ones, and solutions with extrapolation."""

from dataclasses import replace

import numpy as np
import pytest

from bundle_scenes import Scene, bias_variances, scene, with_range_bias
from calgraph.geometry import Array, se3, so3
from calgraph.rig.bundle.bundle_solver import linearize_bundle, minimize_bundle
from calgraph.rig.bundle.linearization import linearize_views
from calgraph.rig.bundle.normal_equations import BiasVariances, ViewNormalEquations
from calgraph.rig.bundle.observations import relative_poses
from calgraph.rig.bundle.range_observations import RangeObservations

STILL, NO_BIAS = np.zeros(0), BiasVariances(np.zeros(6), np.zeros(()), np.zeros(()))


def lidar_views(rng: np.random.Generator) -> tuple[RangeObservations, Array]:
    """Views of boards by a 3-D scanner, and their poses before it."""
    exact = scene(("lidar",), boards=6)
    (views,) = exact.measured(rng).views
    assert isinstance(views, RangeObservations)
    return views, relative_poses(exact.truth.T_root_sensor[0], exact.truth.T_root_board)


def gradients(equations: ViewNormalEquations) -> Array:
    """(V, p) in standard deviations of the best measured direction of each view."""
    return np.asarray(equations.gradient / np.sqrt(np.trace(equations.information, axis1=-2, axis2=-1))[:, None])


def test_extrapolation_by_a_solver_step_is_accurate(rng: np.random.Generator) -> None:
    views, T = lidar_views(rng)
    near = se3.retract(T, 3e-4 * rng.normal(size=(6, 6)))
    extrapolated = linearize_views(views, T, STILL, NO_BIAS, 2.5).extrapolate(views, near, STILL)
    exact_equations = linearize_views(views, near, STILL, NO_BIAS, 2.5).equations
    assert extrapolated is not None
    np.testing.assert_allclose(
        extrapolated.squared_residuals + 2 * extrapolated.robust_cost_offset,
        exact_equations.squared_residuals + 2 * exact_equations.robust_cost_offset,
        rtol=1e-3,
    )
    assert np.abs(gradients(extrapolated) - gradients(exact_equations)).max() < 0.1


def test_the_error_of_extrapolation_shrinks_with_the_step(rng: np.random.Generator) -> None:
    views, T = lidar_views(rng)
    off = []
    for size in (1e-3, 1e-4):
        near = se3.retract(T, np.full((6, 6), size))
        extrapolated = linearize_views(views, T, STILL, NO_BIAS, 2.5).extrapolate(views, near, STILL)
        assert extrapolated is not None
        off.append(
            np.abs(
                gradients(extrapolated) - gradients(linearize_views(views, near, STILL, NO_BIAS, 2.5).equations)
            ).max()
        )
    assert off[1] < 0.15 * off[0]


def test_motion_within_the_plane_does_not_change_ranges(rng: np.random.Generator) -> None:
    views, T = lidar_views(rng)
    slid = T @ se3.pose(so3.exp(np.array([0, 0, 1.0])), np.array([0.4, -0.3, 0]))
    extrapolated = linearize_views(views, T, STILL, NO_BIAS, 2.5).extrapolate(views, slid, STILL)
    assert extrapolated is not None
    np.testing.assert_allclose(
        extrapolated.gradient, linearize_views(views, slid, STILL, NO_BIAS, 2.5).equations.gradient, atol=1e-6
    )


@pytest.mark.parametrize("step", [[0, 0.02, 0, 0, 0, 0], [0, 0, 0, 0.03, 0, 0]], ids=["extrapolated", "turned"])
def test_extrapolation_is_limited(step: list[float], rng: np.random.Generator) -> None:
    views, T = lidar_views(rng)
    far = T.copy()
    far[2] = T[2] @ se3.retract(np.eye(4), np.array(step)[[0, 2, 1, 3, 4, 5]])
    assert linearize_views(views, T, STILL, NO_BIAS, 2.5).extrapolate(views, far, STILL) is None


def test_a_range_bias_is_extrapolated(rng: np.random.Generator) -> None:
    views, T = lidar_views(rng)
    views, zero, biased = with_range_bias(views), np.zeros(1), np.array([0.002])
    extrapolated = linearize_views(views, T, zero, NO_BIAS, 2.5).extrapolate(views, T, biased)
    exact_equations = linearize_views(views, T, biased, NO_BIAS, 2.5).equations
    assert extrapolated is not None
    assert np.abs(gradients(extrapolated) - gradients(exact_equations)).max() < 0.1


@pytest.mark.parametrize("view_bias", [0.0, 0.002])
def test_extrapolation_changes_solutions_by_less_than_a_thousandth_of_their_errors(view_bias: float) -> None:
    exact: Scene = scene(boards=12)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        bundle = replace(
            exact.measured(rng, noise=1.2, view_bias=view_bias), bias_variance=bias_variances(3, view_bias)
        )
        start = replace(
            exact.truth, T_root_board=se3.retract(exact.truth.T_root_board, 0.02 * rng.normal(size=(12, 6)))
        )
        solution = minimize_bundle(bundle, start)
        equations = linearize_bundle(bundle, solution.state)
        P, (_, g, _) = equations.covariance, equations.eliminate_boards()
        assert solution.converged
        assert np.all(np.abs(P @ g) < 1e-3 * np.sqrt(np.diag(P)))


@pytest.mark.parametrize(("share", "extrapolated"), [(0.98, True), (1.02, False)])
def test_views_are_extrapolated_up_to_the_largest_rotation(
    share: float, extrapolated: bool, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 0.1 rad about the board's x axis, with any change of residuals."""
    monkeypatch.setattr("calgraph.rig.bundle.linearization._MAX_RESIDUAL_CHANGE", 1e9)
    monkeypatch.setattr("calgraph.rig.bundle.linearization._MAX_ROTATION", 0.1)
    views, T = lidar_views(rng)
    rotated = T @ se3.pose(so3.exp(np.array([0.1 * share, 0, 0])), np.zeros(3))
    found = linearize_views(views, T, STILL, NO_BIAS, 2.5).extrapolate(views, rotated, STILL)
    assert (found is not None) == extrapolated
