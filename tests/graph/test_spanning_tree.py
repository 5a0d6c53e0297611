"""Start poses along the spanning tree, and the sensors it does not reach."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calgraph.geometry import Array, se3
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.graph.spanning_tree import SpanningTree, find_spanning_tree, unobservable_stddev

TRUTH = {
    name: se3.retract(np.eye(4), np.array(tangent))
    for name, tangent in {
        "lidar": [0, 0, 0, 0, 0, 0],
        "camera": [0.5, 0.1, -0.2, -1.2, 1.2, -1.2],
        "laser": [0.3, -0.4, -0.5, 0.1, 0, 3.0],
        "rear": [-0.6, 0, 0.1, 0, 0, 1.5],
    }.items()
}


def pair(
    a: str, b: str, residual: float, captures: int = 10, information: Array | None = None
) -> PairwiseEstimate:
    """A true estimate whose inliers all have the residual given, m."""
    return PairwiseEstimate(
        sensor_a=a,
        sensor_b=b,
        T_a_b=se3.inverse(TRUTH[a]) @ TRUTH[b],
        information=np.eye(6) * 1e6 if information is None else information,
        matches=np.column_stack([np.arange(captures), np.zeros((captures, 2), dtype=np.intp)]),
        inliers=np.ones(captures, dtype=bool),
        residuals=np.full(captures, residual),
    )


CHAIN = (pair("lidar", "camera", 0.01), pair("camera", "laser", 0.01), pair("laser", "rear", 0.01))


def assert_true_poses(tree: SpanningTree) -> None:
    for name, T in tree.T_root_sensor.items():
        assert_allclose(T, se3.inverse(TRUTH[tree.root]) @ TRUTH[name], atol=1e-12)


def test_poses_are_chained_along_the_tree() -> None:
    tree = find_spanning_tree(
        "lidar", [pair("lidar", "camera", 0.01), pair("camera", "laser", 0.01), pair("laser", "rear", 0.01)]
    )
    assert dict(tree.parents) == {"camera": "lidar", "laser": "camera", "rear": "laser"}
    assert_true_poses(tree)


def test_pairs_may_be_given_either_way_round() -> None:
    tree = find_spanning_tree("lidar", [pair("camera", "lidar", 0.01), pair("laser", "camera", 0.01)])
    assert set(tree.T_root_sensor) == {"lidar", "camera", "laser"}
    assert_true_poses(tree)


def test_the_detour_with_less_error_is_taken() -> None:
    direct = pair("lidar", "laser", 0.03)
    tree = find_spanning_tree("lidar", [direct, pair("lidar", "camera", 0.01), pair("camera", "laser", 0.01)])
    assert tree.parents["laser"] == "camera"


def test_weight_is_the_sum_of_squared_errors_over_captures() -> None:
    many, few = pair("lidar", "laser", 0.01, captures=50), pair("camera", "laser", 0.012, captures=20)
    tree = find_spanning_tree("lidar", [many, few, pair("lidar", "camera", 0.001)])
    assert tree.parents["laser"] == "camera"  # 50 · 0.01² > 20 · 0.012²


def test_a_pair_with_an_open_direction_is_avoided_in_spite_of_its_small_error() -> None:
    hinge = np.diag([1e6, 1e6, 1e6, 1e6, 1e6, 0.0])
    small = pair("lidar", "laser", 0.0001, information=hinge)
    tree = find_spanning_tree("lidar", [small, pair("lidar", "camera", 0.01), pair("camera", "laser", 0.05)])
    assert tree.parents["laser"] == "camera"


def test_a_pair_with_an_open_direction_serves_where_nothing_else_reaches() -> None:
    hinge = np.diag([1e6, 1e6, 1e6, 1e6, 1e6, 0.0])
    tree = find_spanning_tree("lidar", [pair("lidar", "laser", 0.01, information=hinge)])
    assert tree.parents["laser"] == "lidar"


def test_parents_come_before_their_children() -> None:
    tree = find_spanning_tree(
        "rear", [pair("camera", "laser", 0.001), pair("lidar", "camera", 0.001), pair("rear", "lidar", 0.1)]
    )
    reached = {tree.root}
    for child, parent in tree.parents.items():
        assert parent in reached
        reached.add(child)


@pytest.mark.parametrize("root", list(TRUTH))
def test_any_sensor_can_be_the_root(root: str) -> None:
    tree = find_spanning_tree(root, CHAIN)
    assert_allclose(tree.T_root_sensor[root], np.eye(4))
    assert_true_poses(tree)


def test_sensors_without_a_chain_to_the_root_are_left_out() -> None:
    tree = find_spanning_tree("lidar", [pair("lidar", "camera", 0.01), pair("laser", "rear", 0.01)])
    assert set(tree.T_root_sensor) == {"lidar", "camera"}


def test_without_any_pair_the_root_stands_alone() -> None:
    tree = find_spanning_tree("lidar", [])
    assert set(tree.T_root_sensor) == {"lidar"}


def test_tree_knows_which_pairs_it_joins() -> None:
    tree = find_spanning_tree("lidar", [pair("lidar", "camera", 0.01), pair("camera", "laser", 0.01)])
    assert tree.has_edge("lidar", "camera")
    assert tree.has_edge("laser", "camera")
    assert not tree.has_edge("lidar", "laser")


def test_the_standard_deviation_of_an_unobserved_direction_is_that_of_the_weakest() -> None:
    # 1 / sqrt(0.25) m along z, above the limit of 0.1 m; nothing where all directions are below it.
    open_z = pair("lidar", "camera", 0.01, information=np.diag([1e4, 1e4, 0.25, 1e6, 1e6, 1e6]))
    assert unobservable_stddev(open_z, 0.1) == pytest.approx(2.0)
    assert unobservable_stddev(pair("lidar", "camera", 0.01), 0.1) == 0.0
