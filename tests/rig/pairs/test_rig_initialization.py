"""Start poses of a rig by consensus and by the published averaging of all pairs."""

import itertools
from dataclasses import replace
from functools import partial
from typing import Literal, get_args

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calgraph.geometry import Array, se3
from calgraph.graph.averaging import RotationAveraging, average_poses_by_rotations
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.rig.pairs.rig_initialization import Initialization, build_rig_graph, initialize_rig

NAMES = ("lidar", "camera", "laser", "rear", "top")
TANGENTS = np.random.default_rng(3).uniform(-1, 1, size=(5, 6)) * [1, 1, 1, 2, 2, 2]
TRUTH = dict(zip(NAMES, se3.retract(np.eye(4), TANGENTS), strict=True))
METHODS = pytest.mark.parametrize(
    "method",
    ["consensus", *(partial(average_poses_by_rotations, method=name) for name in get_args(RotationAveraging))],
    ids=["consensus", *get_args(RotationAveraging)],
)


def pair(a: str, b: str, error: Array | None = None, residual: float = 0.01) -> PairwiseEstimate:
    """The true relative pose, or one with the error given in a's axes."""
    T_a_b = se3.inverse(TRUTH[a]) @ TRUTH[b]
    matches = np.column_stack([np.arange(10), np.zeros((10, 2), dtype=np.intp)])
    return PairwiseEstimate(
        a, b, T_a_b if error is None else se3.retract(T_a_b, error), np.eye(6) * 1e6,
        matches, np.ones(10, dtype=np.bool_), np.full(10, residual),
    )  # fmt: skip


def pairs_of(names: tuple[str, ...]) -> list[PairwiseEstimate]:
    return [pair(a, b) for a, b in itertools.combinations(names, 2)]


def true_pose(root: str, name: str) -> Array:
    return np.asarray(se3.inverse(TRUTH[root]) @ TRUTH[name])


@METHODS
@pytest.mark.parametrize("root", ["lidar", "rear"])
def test_true_pairs_give_true_poses(method: Initialization, root: str, rng: np.random.Generator) -> None:
    tree = initialize_rig(root, pairs_of(NAMES), method, rng)
    assert tree.root == root
    for name in NAMES:
        assert_allclose(tree.T_root_sensor[name], true_pose(root, name), atol=1e-5)


def test_a_wrong_pair_with_the_least_error_is_no_branch(rng: np.random.Generator) -> None:
    wrong = pair("lidar", "camera", np.array([0.3, 0, 0, 0, 1.0, 0]), residual=0.0001)
    tree = initialize_rig("lidar", [wrong, *pairs_of(NAMES)[1:]], "consensus", rng)
    assert not tree.has_edge("lidar", "camera")
    assert_allclose(tree.T_root_sensor["camera"], true_pose("lidar", "camera"), atol=1e-5)


@METHODS
def test_a_rig_in_a_chain_has_only_one_answer(method: Initialization, rng: np.random.Generator) -> None:
    tree = initialize_rig("lidar", [pair(a, b) for a, b in itertools.pairwise(NAMES)], method, rng)
    assert dict(tree.parents) == dict(zip(NAMES[1:], NAMES[:-1], strict=True))
    assert_allclose(tree.T_root_sensor["top"], true_pose("lidar", "top"), atol=1e-5)


OPEN = np.diag([1e6, 1e6, 1e6, 1e6, 1e6, 0.0])
"""Information of a pair of 2-D scanners, which is open about one axis."""


@METHODS
def test_a_pair_open_about_one_axis_leaves_that_to_the_others(
    method: Initialization, rng: np.random.Generator
) -> None:
    hinge = replace(pair("lidar", "camera", np.array([0, 0, 0, 0, 0, 0.6])), information=OPEN)
    tree = initialize_rig("lidar", [hinge, *pairs_of(NAMES)[1:]], method, rng)
    assert_allclose(tree.T_root_sensor["camera"], true_pose("lidar", "camera"), atol=1e-4)
    assert not tree.has_edge("lidar", "camera")


@METHODS
def test_where_nothing_else_reaches_an_open_pair_is_a_branch(
    method: Initialization, rng: np.random.Generator
) -> None:
    hinges = [replace(pair(a, "top", np.array([0, 0, 0, 0, 0, 0.6])), information=OPEN) for a in ("rear", "laser")]
    tree = initialize_rig("lidar", [*hinges, *pairs_of(NAMES[:4])], method, rng)
    assert tree.parents["top"] in ("rear", "laser")
    parent = tree.parents["top"]
    (branch,) = (e for e in hinges if e.sensor_a == parent)
    assert_allclose(tree.T_root_sensor["top"], true_pose("lidar", parent) @ branch.T_a_b, atol=1e-4)


def test_a_wrong_branch_misleads_the_tree_but_not_the_consensus() -> None:
    """In each of eight rigs of noisy pairs (3 mm, 3 mrad), one pair of the tree is wrong by 0.5 m and 0.5 rad."""
    off: dict[Literal["tree", "consensus"], list[float]] = {"tree": [], "consensus": []}
    for seed in range(8):
        rng = np.random.default_rng(seed)
        noisy = {e: pair(*e, rng.normal(0, 0.003, 6)) for e in itertools.combinations(NAMES, 2)}
        child, parent = list(initialize_rig("lidar", list(noisy.values()), "tree", rng).parents.items())[
            rng.integers(4)
        ]
        end = (parent, child) if (parent, child) in noisy else (child, parent)
        direction = rng.normal(size=(2, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        noisy[end] = pair(*end, 0.5 * direction.ravel(), residual=0.001)
        for start, found in off.items():
            T = initialize_rig("lidar", list(noisy.values()), start, rng).T_root_sensor
            found.append(max(float(np.linalg.norm(T[n][:3, 3] - true_pose("lidar", n)[:3, 3])) for n in NAMES))
    assert min(off["tree"]) > 0.1
    assert max(off["consensus"]) < 0.03


def test_all_sensors_may_start_at_the_root(rng: np.random.Generator) -> None:
    tree = initialize_rig("lidar", pairs_of(NAMES), "identity", rng)
    assert set(tree.T_root_sensor) == set(NAMES)
    for T in tree.T_root_sensor.values():
        assert_allclose(T, np.eye(4))


def test_what_is_not_connected_is_left_out(rng: np.random.Generator) -> None:
    tree = initialize_rig(
        "lidar", [*pairs_of(("lidar", "camera", "laser")), pair("rear", "top")], "consensus", rng
    )
    assert list(tree.T_root_sensor) == ["lidar", "camera", "laser"]


def test_a_rig_without_pairs_is_its_root_alone(rng: np.random.Generator) -> None:
    assert list(initialize_rig("lidar", [], "consensus", rng).T_root_sensor) == ["lidar"]


def test_the_root_is_the_first_node() -> None:
    graph, names = build_rig_graph("rear", pairs_of(NAMES))
    assert names[graph.root] == "rear"
    assert graph.count == 5
    assert len(graph.edges) == 10


def test_pairs_have_a_model_error_of_ten_millimetres_and_five_milliradians() -> None:
    """Added to the covariance of each pair, here 1 mm and 1 mrad."""
    graph, _ = build_rig_graph("lidar", pairs_of(NAMES))
    variances = [1e-6 + 0.01**2] * 3 + [1e-6 + 0.005**2] * 3
    assert_allclose(graph.information[0], np.diag(1 / np.array(variances)), rtol=1e-9)
