"""Changes of poses in time, against solutions of bundles in which each view has a pose of its own."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigvalsh

from bundle_scenes import scene
from calgraph.geometry import Array
from calgraph.rig.bundle.bundle_solver import (
    Bundle,
    BundleState,
    body_jacobian,
    linearize_bundle,
    minimize_bundle,
    retract_state,
)
from calgraph.rig.checks.pose_changes import change_poses, predict_changes, release_poses

BOARDS = 12
SCENE = scene(boards=BOARDS)
TIME = np.arange(BOARDS)
STEP, RAMP, PARITY = np.where(TIME < 5, 0.0, 1.0), TIME / (BOARDS - 1) - 0.5, TIME % 2 - 0.5


def solve_apart(
    bundle: Bundle, state: BundleState, body: int, function: Array, rounds: int
) -> tuple[Array, Array]:
    """The change of a body's pose by a function of the boards, and its information, after Gauss-Newton steps."""
    sensors, views, bodies, T = ["root"], [bundle.views[0].select(TIME < 0)], [0], [state.T_root_sensor[0]]
    by_unknowns = []
    for s, of_sensor in enumerate(bundle.views):
        changed = bundle.body[s] == body
        for board in TIME if changed else [TIME]:
            sensors.append(f"{s} {len(sensors)}")
            views.append(of_sensor.select(np.isin(of_sensor.board, board)))
            bodies.append(len(bodies))
            T.append(state.T_root_sensor[s])
            E = np.zeros((6, bundle.parameter_count + 6))
            E[:, bundle.pose_columns(s)] = body_jacobian(bundle, state, s)[:, : len(bundle.pose_columns(s))]
            if changed:
                E[:, -6:] = function[board] * body_jacobian(bundle, state, s)
            by_unknowns.append(E)
    apart = replace(
        bundle,
        sensors=tuple(sensors),
        views=tuple(views),
        body=np.array(bodies),
        bias_variance=np.tile(bundle.bias_variance[:1], (len(views), 1)),
    )
    state, E, change = replace(state, T_root_sensor=np.array(T)), np.concatenate(by_unknowns), np.zeros(6)
    # That of poses is once for each body, not for each view.
    prior = np.diag(np.append(bundle.prior_stddev, np.full(6, np.inf)) ** -2)
    prior -= E.T @ np.diag(apart.prior_stddev**-2) @ E
    for _ in range(rounds):
        H, g, K = linearize_bundle(apart, state).eliminate_boards()
        information = E.T @ H @ E + prior
        step = -np.linalg.solve(information, E.T @ g)
        state = retract_state(apart, state, E @ step, -(K[..., :-1] @ (E @ step) + K[..., -1]))
        change += step[-6:]
    return change, np.linalg.inv(np.linalg.inv(information)[-6:, -6:])


@pytest.mark.parametrize("function", [STEP, RAMP, PARITY], ids=["step", "ramp", "parity"])
@pytest.mark.parametrize(("groups", "body"), [((0, 1, 2), 0), ((0, 1, 2), 1), ((0, 1, 2), 2), ((0, 1, 1), 1)])
def test_a_change_is_that_of_a_bundle_with_it(groups: tuple[int, ...], body: int, function: Array) -> None:
    """Its first-order prediction is one Gauss-Newton step, and near the solution."""
    bundle = replace(SCENE.measured(np.random.default_rng(body)), body=np.array(groups))
    state = minimize_bundle(bundle, SCENE.truth).state
    found = change_poses(bundle, state, linearize_bundle(bundle, state), function)
    rows = slice(6 * body, 6 * body + 6)
    information, gradient = found.eliminate_parameters(0.0)
    (squared,), (change,) = predict_changes(information[:, rows, rows], gradient[:, rows])
    # Robust weights of ranges are iterated over the views of a set together: they differ by a thousandth.
    expected, weight = solve_apart(bundle, state, body, function, rounds=1)
    np.testing.assert_allclose(eigvalsh(information[0, rows, rows], weight), 1, atol=5e-3)
    assert (change - expected) @ weight @ (change - expected) < 5e-3**2
    assert squared == pytest.approx(expected @ weight @ expected, rel=5e-3)
    solved, weight = solve_apart(bundle, state, body, function, rounds=4)
    assert (change - solved) @ weight @ (change - solved) < 0.3**2
    assert squared == pytest.approx(solved @ weight @ solved, rel=0.2)


@pytest.mark.parametrize("sensor", range(3))
def test_changes_in_several_views_are_sums_of_those_in_each(sensor: int) -> None:
    bundle = SCENE.measured(np.random.default_rng(0))
    solution = minimize_bundle(bundle, SCENE.truth)
    released = release_poses(bundle, solution.state, solution.equations)[sensor]
    combined = released.combine(lambda of_views: np.tensordot([STEP, PARITY > 0], of_views, axes=1))
    squared, change = combined.test(0.0)
    rows = slice(6 * sensor, 6 * sensor + 6)
    for i, function in enumerate((STEP, PARITY + 0.5)):
        at_once = change_poses(bundle, solution.state, solution.equations, function)
        information, gradient = at_once.eliminate_parameters(0.0)
        expected = predict_changes(information[:, rows, rows], gradient[:, rows])
        assert squared[i] == pytest.approx(expected[0][0], rel=1e-5)
        np.testing.assert_allclose(change[i], expected[1][0], rtol=1e-4, atol=1e-9)


def test_the_estimate_follows_a_change_by_its_influence() -> None:
    """A pose that the bundle keeps constant is the mean of one that changes."""
    bundle = SCENE.measured(np.random.default_rng(0))
    solution = minimize_bundle(bundle, SCENE.truth)
    influence = change_poses(bundle, solution.state, solution.equations, STEP).influence[0]
    share = np.diag(influence[6:12, :6])
    # Seven of twelve views are after the step.
    assert 0.4 < share.mean() < 0.75
