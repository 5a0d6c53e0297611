"""Normal equations of legs, against numerical derivatives of the cost."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.geometry import Array, se2
from calgraph.network.joint.problem import NetworkProblem, NetworkState
from calgraph.network.joint.scanner_unknowns import SCANNER_UNKNOWNS
from calgraph.network.joint.solver import NetworkEquations, apply_step, linearize_network, optimize_network
from leg_scenes import OFFSET, SHAPE, T_ROOT, build_network
from network_scenes import list_body_equations


@pytest.fixture(autouse=True)
def measure_edges_exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    """The noise of ranges does not depend on the state."""
    monkeypatch.setattr("calgraph.network.joint.legs._EDGE_SIGMA", 0.0)


def move(
    problem: NetworkProblem, state: NetworkState, step: list[Array], scanners: Array, size: float
) -> NetworkState:
    return apply_step(problem, state, size * scanners, [size * one for one in step])


def random_step(rng: np.random.Generator, state: NetworkState) -> tuple[list[Array], Array]:
    steps = []
    for path in state.paths:
        steps.append(rng.normal(0, 1e-3, path.control.size + 5 + 3))
    scanners = rng.normal(0, 1e-3, (3, SCANNER_UNKNOWNS))
    return steps, scanners.ravel()


def slope(equations: NetworkEquations, steps: list[Array], scanners: Array) -> float:
    total = equations.g @ scanners
    for body, columns, step in zip(list_body_equations(equations), equations.columns, steps, strict=True):
        total -= body.predict_decrease(step, scanners[columns], damping=0.0)
    return float(total)


@pytest.fixture(scope="module")
def network() -> tuple[NetworkProblem, NetworkState]:
    return build_network()


def test_gradient_is_the_derivative_of_the_cost(network: tuple[NetworkProblem, NetworkState]) -> None:
    problem, state = network
    rng = np.random.default_rng(0)
    start, offset = random_step(rng, state)
    state = move(problem, state, start, offset, 1.0)
    equations = linearize_network(problem, state)
    for _ in range(3):
        steps, scanners = random_step(rng, state)
        costs = [linearize_network(problem, move(problem, state, steps, scanners, h)).cost for h in (1e-4, -1e-4)]
        assert slope(equations, steps, scanners) == pytest.approx((costs[0] - costs[1]) / 2e-4, rel=5e-4)


def test_solution_recovers_scanners_and_shapes(network: tuple[NetworkProblem, NetworkState]) -> None:
    problem, state = network
    rng = np.random.default_rng(1)
    wrong = se2.retract(T_ROOT, np.vstack([np.zeros(3), rng.normal(0, [0.02, 0.02, 0.005], (2, 3))]))
    start = replace(state, T_root_scanner=wrong, clock_offset=np.zeros(3))
    found, _ = optimize_network(problem, start, iterations=30)
    error = se2.difference(found.T_root_scanner, T_ROOT)
    assert np.abs(error).max() < 1e-3
    assert found.clock_offset == pytest.approx(OFFSET, abs=1e-3)
    for path in found.paths:
        # The prior of the radius, 65 ± 15 mm, pulls by less than a tenth of a millimetre.
        assert path.shape[0] == pytest.approx(SHAPE[0], abs=1e-3)
