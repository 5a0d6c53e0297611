"""Every edge's analytic Jacobian against central differences over the manifold."""

from collections.abc import Callable

import numpy as np
import pytest

from calgraph.geometry import Array, Index, plane, se3, so3
from calgraph.rig.published import hypergraph_factors as edges
from calgraph.rig.published.hypergraph import BLOCKS
from calgraph.rig.published.sparse_lm import Factor, Values

M = 7
SENSORS, PLANES, LINES = 4, 6, 6


def random_values(rng: np.random.Generator) -> Values:
    planes = rng.normal(size=(PLANES, 4))
    planes[:, :3] /= np.linalg.norm(planes[:, :3], axis=1, keepdims=True)
    return {
        "sensors": se3.pose(so3.exp(rng.normal(size=(SENSORS, 3))), rng.normal(size=(SENSORS, 3))),
        "planes": planes,
        "lines": rng.normal(size=(LINES, 2, 3)),
    }


def random_whitener(rng: np.random.Generator, size: int) -> Array:
    root = rng.normal(size=(M, size, size))
    return edges.whitener(root @ np.swapaxes(root, 1, 2) + np.eye(size))


def index(rng: np.random.Generator, count: int) -> Index:
    return rng.integers(count, size=M)


def two(rng: np.random.Generator) -> tuple[Index, Index]:
    pairs = np.array([rng.choice(SENSORS, 2, replace=False) for _ in range(M)])
    return pairs[:, 0], pairs[:, 1]


def lines_of(rng: np.random.Generator) -> tuple[Index, Index]:
    pairs = np.array([rng.choice(LINES, 2, replace=False) for _ in range(M)])
    return pairs[:, 0], pairs[:, 1]


def make(kind: str, rng: np.random.Generator) -> Factor:
    a, b = two(rng)
    first, second = lines_of(rng)
    near = random_values(rng)
    kinds: dict[str, Callable[[], Factor]] = {
        "sensor-sensor": lambda: edges.SensorSensor(
            a, b, near["sensors"][index(rng, SENSORS)], random_whitener(rng, 6)
        ),
        "sensor-line": lambda: edges.SensorLine(first, rng.normal(size=(M, 2, 3)), random_whitener(rng, 6)),
        "sensor-plane": lambda: edges.SensorPlane(
            first, near["planes"][index(rng, PLANES)], random_whitener(rng, 3)
        ),
        "line-plane": lambda: edges.LinePlane(a, first, b, second, 0.5),
        "plane-plane": lambda: edges.PlanePlane(a, first, b, second, 0.5),
        "line-line": lambda: edges.LineLine(a, first, b, second, 0.5),
    }
    return kinds[kind]()


KINDS = ("sensor-sensor", "sensor-line", "sensor-plane", "line-plane", "plane-plane", "line-line")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_jacobian(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    values, edge = random_values(rng), make(kind, rng)
    r, terms = edge.linearize(values)
    for block in values:
        dim = BLOCKS[block].dim
        analytic = np.zeros((*r.shape, len(values[block]), dim))
        for term in terms:
            if term.block == block:
                for m in range(M):
                    analytic[m, :, term.index[m]] += term.jacobian[m]
        numeric = np.zeros_like(analytic)
        for v in range(len(values[block])):
            for k in range(dim):
                delta = np.zeros((len(values[block]), dim))
                delta[v, k] = 1e-6
                plus = {**values, block: BLOCKS[block].retract(values[block], delta)}
                minus = {**values, block: BLOCKS[block].retract(values[block], -delta)}
                numeric[:, :, v, k] = (edge.linearize(plus)[0] - edge.linearize(minus)[0]) / 2e-6
        np.testing.assert_allclose(analytic, numeric, atol=2e-6 * max(1, np.abs(numeric).max()))


def test_consistent_observations_have_no_error(rng: np.random.Generator) -> None:
    """One board seen by all: every observation edge vanishes at the truth."""
    values = random_values(rng)
    board = plane.from_pose(se3.pose(so3.exp(rng.normal(size=3)), rng.normal(size=3)))
    T_s_r = se3.inverse(values["sensors"])
    planes = plane.transform(T_s_r, np.broadcast_to(board, (SENSORS, 4)))
    basis = plane.tangent_basis(board[:3])
    x_r = -board[3] * board[:3] + rng.normal(size=(SENSORS, 2, 2)) @ basis.T
    seen = {"sensors": values["sensors"], "planes": planes, "lines": se3.apply(T_s_r, x_r)}
    a, b = two(rng)
    for edge in (
        edges.LinePlane(a, a, b, b, 1.0),
        edges.PlanePlane(a, a, b, b, 1.0),
        edges.LineLine(a, a, b, b, 1.0),
    ):
        np.testing.assert_allclose(edge.linearize(seen)[0], 0, atol=1e-12)
