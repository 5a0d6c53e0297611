"""Start poses of a rig from all its pairs at once."""

import itertools
from typing import get_args

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calgraph.geometry import Array, se3
from calgraph.graph import Method, averaged_tree, pose_graph
from calgraph.pairwise import PairwiseEstimate

NAMES = ("lidar", "camera", "laser", "rear", "top")
TANGENTS = np.random.default_rng(3).uniform(-1, 1, size=(5, 6)) * [1, 1, 1, 2, 2, 2]
TRUTH = dict(zip(NAMES, se3.retract(np.eye(4), TANGENTS), strict=True))
METHODS = pytest.mark.parametrize("method", get_args(Method))


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
def test_true_pairs_give_true_poses(method: Method, root: str, rng: np.random.Generator) -> None:
    tree = averaged_tree(root, pairs_of(NAMES), rng, method)
    assert tree.root == root
    for name in NAMES:
        assert_allclose(tree.T_root_sensor[name], true_pose(root, name), atol=1e-5)


def test_a_wrong_pair_with_the_least_error_is_no_branch(rng: np.random.Generator) -> None:
    wrong = pair("lidar", "camera", np.array([0.3, 0, 0, 0, 1.0, 0]), residual=0.0001)
    tree = averaged_tree("lidar", [wrong, *pairs_of(NAMES)[1:]], rng)
    assert not tree.joins("lidar", "camera")
    assert_allclose(tree.T_root_sensor["camera"], true_pose("lidar", "camera"), atol=1e-5)


@METHODS
def test_a_rig_in_a_chain_has_only_one_answer(method: Method, rng: np.random.Generator) -> None:
    tree = averaged_tree("lidar", [pair(a, b) for a, b in itertools.pairwise(NAMES)], rng, method)
    assert dict(tree.parents) == dict(zip(NAMES[1:], NAMES[:-1], strict=True))
    assert_allclose(tree.T_root_sensor["top"], true_pose("lidar", "top"), atol=1e-5)


def test_a_pair_open_about_one_axis_leaves_that_to_the_others(rng: np.random.Generator) -> None:
    hinged = pair("lidar", "camera", np.array([0, 0, 0, 0, 0, 0.6]))
    hinge = PairwiseEstimate(
        hinged.sensor_a, hinged.sensor_b, hinged.T_a_b, np.diag([1e6, 1e6, 1e6, 1e6, 1e6, 0.0]),
        hinged.matches, hinged.inliers, hinged.residuals,
    )  # fmt: skip
    tree = averaged_tree("lidar", [hinge, *pairs_of(NAMES)[1:]], rng)
    assert_allclose(tree.T_root_sensor["camera"], true_pose("lidar", "camera"), atol=1e-4)


def test_what_is_not_connected_is_left_out(rng: np.random.Generator) -> None:
    tree = averaged_tree("lidar", [*pairs_of(("lidar", "camera", "laser")), pair("rear", "top")], rng)
    assert list(tree.T_root_sensor) == ["lidar", "camera", "laser"]


def test_a_rig_without_pairs_is_its_root_alone(rng: np.random.Generator) -> None:
    assert list(averaged_tree("lidar", [], rng).T_root_sensor) == ["lidar"]


def test_the_root_is_the_first_node() -> None:
    graph, names = pose_graph("rear", pairs_of(NAMES))
    assert names[graph.root] == "rear"
    assert graph.count == 5
    assert len(graph.edges) == 10
