"""Outlines: differentiated as numbers say, unbiased, and telling where in its plane a board is."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from bundle_scenes import HEIGHT, WIDTH, scene
from calgraph.boards.detections import PlanePatch
from calgraph.config import Lidar2dUncertainty
from calgraph.geometry import Array, se3, so3
from calgraph.rig.bundle.bundle_parameters import LocalParameters, SystematicParameter
from calgraph.rig.bundle.bundle_solver import linearize_bundle, minimize_bundle
from calgraph.rig.bundle.covariances import pose_covariance
from calgraph.rig.bundle.observations import relative_poses
from calgraph.rig.bundle.outline_observations import OutlineObservations

HALF = np.array([WIDTH, HEIGHT]) / 2
BEFORE = se3.pose(so3.exp(np.array([2.8, 0.3, -0.2])), np.array([0.2, -0.1, 2.0]))
STEP = 0.02
# Number of edges on each side of a board.
EACH = 6


def crossings(rng: np.random.Generator, each: int = EACH, step: float = STEP) -> Array:
    """(4 each, 2, 2) places on and past each side of the board, where beams ``step`` apart meet its plane."""
    along = rng.uniform(-0.8, 0.8, (4, each))
    n = np.repeat(np.array([[-1.0, 0], [1, 0], [0, -1], [0, 1]])[:, None], each, axis=1)
    at = n * HALF + along[..., None] * HALF * np.abs(n[..., ::-1])
    across = step * (n + rng.uniform(-0.3, 0.3, n.shape) * n[..., ::-1])
    on = at - rng.uniform(size=(4, each, 1)) * across
    return np.stack([on, on + across], axis=-2).reshape(-1, 2, 2)


def edges_of(T_sensor_board: Array, places: Array) -> Array:
    """(M, 2, 3) directions to places (M, 2, 2) on the board's plane."""
    at = se3.apply(T_sensor_board, np.concatenate([places, np.zeros((*places.shape[:-1], 1))], axis=-1))
    return np.asarray(at / np.linalg.norm(at, axis=-1, keepdims=True))


def patch(edges: Array) -> PlanePatch:
    return PlanePatch(
        np.array([0, 0, -1, 2.0]), np.eye(3), np.zeros(0), np.zeros((0, 3)), np.array([0, 0, 2.0]), edges=edges
    )


def outline(T_sensor_board: Array, edges: list[Array]) -> OutlineObservations:
    """Of boards (V, 4, 4), with one footprint between all beams."""
    views = OutlineObservations.from_edges(
        range(len(edges)), [patch(one) for one in edges], np.tile(HALF, (len(edges), 1))
    )
    index = views.parameters.index.copy()
    index[:, views.parameters["varying"]] = 0
    parameters = replace(views.parameters, index=index, count=1)
    return replace(views, parameters=parameters).update_noise(T_sensor_board, 1.0)


def test_derivatives_of_outlines_are_the_numerical_ones() -> None:
    rng, small = np.random.default_rng(0), 1e-6
    T = np.stack([BEFORE, se3.retract(BEFORE, np.array([0.3, 0.2, 0.5, 0.4, -0.3, 0.8]))])
    views = outline(T, [edges_of(one, crossings(rng)) for one in T])
    # Elsewhere than where they were made for: then their places on the boards matter.
    T = se3.retract(T, np.tile([0.02, -0.01, 0.1, 0.1, -0.1, 0.02], (2, 1)))
    turns = tuple(error for error in Lidar2dUncertainty().beam_errors() if error.turn)
    none = LocalParameters.exact(2, {"size": 2, "print": 3, "beams": len(turns), "varying": 2})
    count = none.index.shape[1]
    parameters = replace(none, index=np.tile(np.arange(count), (2, 1)), count=count)
    views = replace(views, parameters=parameters, turns=turns)
    extra = np.array([0.003, -0.002, 0.01, -0.02, 0.05, 0.01, 0.003, -0.004])

    def residual(step: Array) -> Array:
        return views.linearize(se3.retract(T, np.tile(step[:6], (2, 1))), extra + step[6:]).residual.ravel()

    numbers = np.stack([(residual(s) - residual(-s)) / (2 * small) for s in small * np.eye(6 + count)], axis=-1)
    linearized = views.linearize(T, extra)
    view = np.repeat([0, 1], np.diff(views.start, append=len(linearized.residual)))
    assert len(view) > 40
    np.testing.assert_allclose(
        (linearized.jacobian @ linearized.local_jacobian[view])[:, 0], numbers, rtol=1e-5, atol=1e-4
    )


def test_residual_of_an_outline_is_the_displacement_of_the_board() -> None:
    places = np.array([[[HALF[0] - 0.01, 0.1], [HALF[0] + 0.01, 0.1]]])
    views = outline(BEFORE[None], [edges_of(BEFORE, places)])
    moved = BEFORE @ se3.pose(np.eye(3), np.array([0.005, 0.0, 0.0]))
    found = views.linearize(moved[None], np.zeros(1)).residual * views.sigma
    # Predicted minus measured: the side is farther out than the beams are.
    np.testing.assert_allclose(found, 0.005, atol=1e-4)


def test_residuals_of_outlines_have_the_stated_variance_and_no_mean() -> None:
    rng = np.random.default_rng(1)
    views = outline(BEFORE[None], [edges_of(BEFORE, crossings(rng, each=2000))])
    # Beams apart by 20 mm at random phases, and 2 mm of blur that these boards do not have.
    whitened = views.linearize(BEFORE[None], np.zeros(1)).residual[:, 0]
    assert abs(whitened.mean()) < 4 / np.sqrt(len(whitened))
    assert whitened.std() == pytest.approx(np.sqrt(1 / (1 + 12 * (0.002 / STEP) ** 2)), rel=0.04)


@pytest.mark.parametrize(
    "places",
    [
        [[0.2, 0.1], [0.22, 0.1]],
        [[HALF[0] - 0.01, 0.1], [HALF[0] - 0.03, 0.1]],
        [[HALF[0] - 0.01, HALF[1] - 0.01], [HALF[0] + 0.01, HALF[1] - 0.01]],
        [[HALF[0] - 0.06, 0.1], [HALF[0] + 0.06, 0.1]],
        [[HALF[0] + 0.2, 0.1], [HALF[0] + 0.22, 0.1]],
    ],
    ids=["a hole", "inward", "a corner", "coarse", "an arm"],
)
def test_ambiguous_edges_are_not_used(places: list[list[float]]) -> None:
    views = outline(BEFORE[None], [edges_of(BEFORE, np.array([places]))])
    assert len(views.used) == 0
    assert views.linearize(BEFORE[None], np.zeros(1)).residual.shape == (0, 1)


def test_selected_outlines_have_the_same_residuals() -> None:
    rng = np.random.default_rng(2)
    T = se3.retract(BEFORE, rng.uniform(-0.2, 0.2, (4, 6)))
    views = outline(T, [edges_of(one, crossings(rng, each=3)) for one in T])
    keep: NDArray[np.intp] = np.array([3, 1])
    some = views.select(keep)
    parts = np.split(views.linearize(T, np.zeros(1)).residual, views.start[1:])
    np.testing.assert_array_equal(some.board, keep)
    np.testing.assert_array_equal(
        some.linearize(T[keep], np.zeros(1)).residual, np.concatenate([parts[3], parts[1]])
    )


def test_edge_points_are_on_the_outline() -> None:
    places = crossings(np.random.default_rng(3))
    views, found = outline(BEFORE[None], [edges_of(BEFORE, places)]).edge_points(BEFORE[None])
    np.testing.assert_allclose(found, places.mean(axis=1), atol=1e-9)
    assert not views.any()


def test_errors_with_outlines_are_consistent_with_the_covariance() -> None:
    """Two LiDARs: outlines make every axis surer than their planes alone, and covariances hold."""
    exact = scene(("lidar", "lidar_2"), boards=8).without_bias()
    T_sensor_board = [relative_poses(T, exact.truth.T_root_board) for T in exact.truth.T_root_sensor]
    footprints = tuple(SystematicParameter("", "footprint", "m", 0.01, (2 + s,)) for s in range(2))
    state = replace(exact.truth, extra=np.zeros(2))
    nees, stated, plain = [], [], []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        measured = exact.measured(rng)
        outlines = tuple(outline(T, [edges_of(one, crossings(rng)) for one in T]) for T in T_sensor_board)
        bundle = replace(
            measured,
            outlines=outlines,
            outline_sensor=(0, 1),
            extra_parameters=footprints,
            bias_variance=np.zeros((4, 4)),
        )
        solution = minimize_bundle(bundle, state)
        spread = pose_covariance(bundle, solution.state, solution.equations)[6:, 6:]
        error = se3.difference(solution.state.T_root_sensor[1], exact.truth.T_root_sensor[1])
        nees.append(error @ np.linalg.solve(spread, error) / 6)
        stated.append(np.sqrt(np.diag(spread)))
        without = pose_covariance(measured, exact.truth, linearize_bundle(measured, exact.truth))[6:, 6:]
        plain.append(np.sqrt(np.diag(without)))
    assert np.mean(nees) == pytest.approx(1.0, abs=0.3)
    assert np.all(np.mean(stated, axis=0) < np.mean(plain, axis=0))
