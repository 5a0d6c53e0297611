"""Sums moved along are those that looking at every beam gives, and solutions do not depend on what was moved."""

from dataclasses import replace

import numpy as np
import pytest

from bundle_scenes import Scene, scene
from calgraph.estimation.rig.bundle_solver import linearize_bundle, minimize_bundle
from calgraph.estimation.rig.covariances import parameter_covariance
from calgraph.estimation.rig.normal_equations import ViewNormalEquations
from calgraph.estimation.rig.observations import RangeObservations, relative_poses
from calgraph.estimation.rig.relinearization import linearize_views
from calgraph.geometry import Array, se3, so3

STILL, SWAY = np.zeros(0), np.zeros(6)


def seen(rng: np.random.Generator) -> tuple[RangeObservations, Array]:
    """What a 3-D scanner measures of boards, and their poses before it."""
    exact = scene(("lidar",), boards=6)
    (views,) = exact.measured(rng).views
    assert isinstance(views, RangeObservations)
    return views, relative_poses(exact.truth.T_root_sensor[0], exact.truth.T_root_board)


def gradients(sums: ViewNormalEquations) -> Array:
    """(V, p) in standard deviations of what each view tells best."""
    return np.asarray(sums.gradient / np.sqrt(np.trace(sums.information, axis1=-2, axis2=-1))[:, None])


def test_sums_moved_by_a_step_of_the_solver_are_those_of_all_beams(rng: np.random.Generator) -> None:
    views, T = seen(rng)
    near = se3.retract(T, 3e-4 * rng.normal(size=(6, 6)))
    moved = linearize_views(views, T, STILL, SWAY).extrapolate(views, near, STILL)
    anew = linearize_views(views, near, STILL, SWAY).equations
    assert moved is not None
    np.testing.assert_allclose(
        moved.squared_residuals + 2 * moved.robust_cost_offset,
        anew.squared_residuals + 2 * anew.robust_cost_offset,
        rtol=1e-3,
    )
    assert np.abs(gradients(moved) - gradients(anew)).max() < 0.1


def test_the_smaller_the_step_the_nearer_are_sums_to_those_of_all_beams(rng: np.random.Generator) -> None:
    views, T = seen(rng)
    off = []
    for size in (1e-3, 1e-4):
        near = se3.retract(T, np.full((6, 6), size))
        moved = linearize_views(views, T, STILL, SWAY).extrapolate(views, near, STILL)
        assert moved is not None
        off.append(np.abs(gradients(moved) - gradients(linearize_views(views, near, STILL, SWAY).equations)).max())
    assert off[1] < 0.15 * off[0]


def test_a_board_that_slides_and_turns_in_its_plane_has_not_moved(rng: np.random.Generator) -> None:
    views, T = seen(rng)
    slid = T @ se3.pose(so3.exp(np.array([0, 0, 1.0])), np.array([0.4, -0.3, 0]))
    moved = linearize_views(views, T, STILL, SWAY).extrapolate(views, slid, STILL)
    assert moved is not None
    np.testing.assert_allclose(
        moved.gradient, linearize_views(views, slid, STILL, SWAY).equations.gradient, atol=1e-6
    )


@pytest.mark.parametrize("step", [[0, 0.02, 0, 0, 0, 0], [0, 0, 0, 0.03, 0, 0]], ids=["moved", "turned"])
def test_sums_are_not_moved_far(step: list[float], rng: np.random.Generator) -> None:
    views, T = seen(rng)
    far = T.copy()
    far[2] = T[2] @ se3.retract(np.eye(4), np.array(step)[[0, 2, 1, 3, 4, 5]])
    assert linearize_views(views, T, STILL, SWAY).extrapolate(views, far, STILL) is None


def test_an_unknown_bias_is_moved_along(rng: np.random.Generator) -> None:
    views, T = seen(rng)
    views, zero, biased = replace(views, extra_count=1), np.zeros(1), np.array([0.002])
    moved = linearize_views(views, T, zero, np.zeros(7)).extrapolate(views, T, biased)
    anew = linearize_views(views, T, biased, np.zeros(7)).equations
    assert moved is not None
    assert np.abs(gradients(moved) - gradients(anew)).max() < 0.1


@pytest.mark.parametrize("sway", [0.0, 0.002])
def test_solutions_are_those_of_all_measurements_to_a_thousandth_of_their_errors(sway: float) -> None:
    exact: Scene = scene(boards=12)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        bundle = replace(exact.measured(rng, noise=1.2, sway=sway), bias_variance=np.full(3, sway**2))
        start = replace(
            exact.truth, T_root_board=se3.retract(exact.truth.T_root_board, 0.02 * rng.normal(size=(12, 6)))
        )
        solved = minimize_bundle(bundle, start)
        system = linearize_bundle(bundle, solved.state)
        P, (_, g, _) = parameter_covariance(system), system.eliminate_boards()
        assert solved.converged
        assert np.all(np.abs(P @ g) < 1e-3 * np.sqrt(np.diag(P)))
