"""Robust weights of views, with which variances settle before any view is rejected."""

from dataclasses import replace

import numpy as np

from bundle_scenes import Scene, bias_variances, remeasured, scene
from calgraph.geometry import se3
from calgraph.rig.bundle.bundle_solver import Bundle, linearize_bundle, minimize_bundle, retract_state
from calgraph.rig.bundle.observations import relative_poses

SENSORS = ("lidar", "camera", "lidar2", "laser")
OUTLIERS = 3


def with_outliers(exact: Scene, seed: int) -> Bundle:
    """The camera's first views are of the boards 10 cm to one side and 5 cm nearer."""
    rng = np.random.default_rng(seed)
    bundle = replace(exact.measured(rng), bias_variance=bias_variances(len(SENSORS), 0.003))
    off = np.zeros((len(exact.truth.T_root_board), 6))
    off[:OUTLIERS, :3] = 0.1, 0.0, -0.05
    T = se3.retract(relative_poses(exact.truth.T_root_sensor[1], exact.truth.T_root_board), off)
    views = list(bundle.views)
    views[1] = remeasured(exact.bundle.views[1], T, rng, 1.0)
    return replace(bundle, views=tuple(views))


def test_outlier_views_alone_lose_weight() -> None:
    exact = scene(SENSORS, boards=15)
    bundle = with_outliers(exact, seed=0)
    plain, robust = (
        linearize_bundle(replace(bundle, robust_views=robust), exact.truth).views for robust in (False, True)
    )
    for k, (of_all, weighted) in enumerate(zip(plain, robust, strict=True)):
        weight = weighted.information[:, 0, 0] / of_all.information[:, 0, 0]
        others = slice(OUTLIERS if k == 1 else 0, None)
        assert weight[others].tolist() == [1.0] * len(weight[others])
    assert np.all(robust[1].information[:OUTLIERS, 0, 0] < 0.3 * plain[1].information[:OUTLIERS, 0, 0])


def test_outlier_views_move_a_robust_solution_less() -> None:
    exact = scene(SENSORS, boards=15)
    errors = np.zeros((2, 6))
    for seed in range(6):
        bundle = with_outliers(exact, seed)
        for robust in (False, True):
            found = minimize_bundle(replace(bundle, robust_views=robust), exact.truth).state.T_root_sensor[1]
            errors[int(robust), seed] = np.linalg.norm((found - exact.truth.T_root_sensor[1])[:3, 3])
    assert errors[1].mean() < 0.5 * errors[0].mean()


def test_the_gradient_is_that_of_the_robust_cost() -> None:
    exact = scene(SENSORS, boards=6)
    bundle = replace(with_outliers(exact, seed=0), robust_views=True)
    at, boards = linearize_bundle(bundle, exact.truth), np.zeros((6, 6))
    for column in range(6, 12):
        step = np.zeros(len(at.g))
        step[column] = 1e-6
        ahead, behind = (
            linearize_bundle(bundle, retract_state(bundle, exact.truth, sign * step, boards)).cost
            for sign in (1, -1)
        )
        np.testing.assert_allclose(
            (ahead - behind) / 2e-6, at.g[column], rtol=2e-2, atol=1e-3 * np.abs(at.g).max()
        )
