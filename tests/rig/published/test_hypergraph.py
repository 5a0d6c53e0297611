"""The joint solution on detections made from the truth: accuracy and honesty over many seeds, and ugly cases."""

import itertools
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import get_args

import numpy as np
import pytest
import scipy.stats

from board_scenes import SIZE, detect_boards, make_boards
from calgraph.config.settings import BoardPairSettings, Settings
from calgraph.errors import Rejected
from calgraph.geometry import Array, diagonal_blocks, se3, so3
from calgraph.graph.averaging import RotationAveraging, average_poses_by_rotations
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.graph.spanning_tree import SpanningTree, find_spanning_tree
from calgraph.rig.pairs.board_matches import Candidates
from calgraph.rig.pairs.board_pair import estimate_pair
from calgraph.rig.pairs.rig_initialization import Initialization, initialize_rig
from calgraph.rig.published.hypergraph import HypergraphSolution, solve_hypergraph

World = tuple[dict[str, Array], dict[str, Candidates], list[PairwiseEstimate], SpanningTree]
KINDS = {"lidar": "plane", "camera": "plane", "front": "line", "left": "line"}


def world(seed: int, captures: int = 40, moved: int = 0) -> World:
    rng = np.random.default_rng(seed)
    truth = {name: se3.pose(so3.exp(rng.normal(size=3) * 0.2), rng.normal(size=3) * 0.2) for name in KINDS}
    truth["lidar"] = np.eye(4)
    scene = make_boards(rng, captures)
    seen: dict[str, Candidates] = {}
    for name, kind in KINDS.items():
        slipped = scene.copy()
        for i in rng.choice(captures, moved, replace=False):
            slipped[i] = se3.retract(slipped[i], rng.normal(size=6) * 0.2)
        seen[name] = detect_boards(kind, se3.inverse(truth[name]), slipped, rng)
    found = [
        estimate_pair(a, b, seen[a], seen[b], SIZE, rng, settings=BoardPairSettings())
        for a, b in itertools.combinations(KINDS, 2)
        if KINDS[a] == "plane"
    ]
    pairs = [pair for pair in found if not isinstance(pair, Rejected)]
    return truth, seen, pairs, find_spanning_tree("lidar", pairs)


def covariances(joint: HypergraphSolution) -> dict[str, Array]:
    return dict(zip(joint.T_root_sensor, diagonal_blocks(joint.joint_covariance, 6), strict=True))


def nees(joint: HypergraphSolution, truth: Mapping[str, Array]) -> Array:
    values = []
    for name, T in truth.items():
        if name != "lidar":
            e = se3.difference(joint.T_root_sensor[name], T)
            values.append(e @ np.linalg.solve(covariances(joint)[name], e))
    return np.array(values)


def test_the_joint_solution_beats_the_tree_it_starts_from() -> None:
    """Over 12 rigs, as the paper's Figure 5 says: mean error over sensors and rigs."""
    pairwise: list[list[float]] = []
    joint: list[list[float]] = []
    for seed in range(12):
        truth, seen, pairs, tree = world(seed)
        for result, found in (
            (pairwise, tree.T_root_sensor),
            (joint, solve_hypergraph(tree, pairs, seen, settings=Settings()).T_root_sensor),
        ):
            result.append(
                [float(np.linalg.norm(se3.difference(found[n], truth[n])[:3])) for n in truth if n != "lidar"]
            )
    assert np.mean(joint) < 0.65 * np.mean(pairwise)
    assert np.mean(joint) < 0.0035


@pytest.fixture(scope="module")
def solved() -> list[tuple[dict[str, Array], HypergraphSolution]]:
    """Truth and solution of twelve rigs."""
    return [
        (truth, solve_hypergraph(tree, pairs, seen, settings=Settings()))
        for truth, seen, pairs, tree in map(world, range(12))
    ]


def test_covariances_hold_what_they_promise(solved: list[tuple[dict[str, Array], HypergraphSolution]]) -> None:
    """Mean NEES of twelve rigs, three sensors and six degrees of freedom each, within its 99.9 % interval."""
    values = np.concatenate([nees(joint, truth) for truth, joint in solved])
    low, high = scipy.stats.chi2.interval(0.999, 6 * len(values)) / np.array(6 * len(values))
    assert low < values.mean() / 6 < high


@pytest.mark.parametrize(("a", "b"), [("camera", "front"), ("front", "left"), ("left", "camera")])
def test_covariances_between_sensors_hold_what_they_promise(
    a: str, b: str, solved: list[tuple[dict[str, Array], HypergraphSolution]]
) -> None:
    """As above, for a pair that the root is not in."""
    values = []
    for truth, joint in solved:
        order = list(joint.T_root_sensor)
        both = np.concatenate([6 * order.index(name) + np.arange(6) for name in (a, b)])
        T_root_a, T_root_b = joint.T_root_sensor[a], joint.T_root_sensor[b]
        covariance = se3.relative_covariance(T_root_a, T_root_b, joint.joint_covariance[np.ix_(both, both)])
        e = se3.difference(se3.inverse(T_root_a) @ T_root_b, se3.inverse(truth[a]) @ truth[b])
        values.append(e @ np.linalg.solve(covariance, e))
    low, high = scipy.stats.chi2.interval(0.999, 6 * len(values)) / np.array(6 * len(values))
    assert low < np.mean(values) / 6 < high


@pytest.mark.parametrize(
    "start",
    [
        "identity",
        "consensus",
        *(partial(average_poses_by_rotations, method=m) for m in get_args(RotationAveraging)),
    ],
    ids=["identity", "consensus", *get_args(RotationAveraging)],
)
def test_every_start_finds_the_same(start: Initialization, rng: np.random.Generator) -> None:
    """Although the estimate of one pair, which is a branch of the tree, is wrong by 0.2 m and 11 degrees."""
    _, seen, pairs, tree = world(3)
    wrong = np.array([tree.has_edge(pair.sensor_a, pair.sensor_b) for pair in pairs]).argmax()
    pairs[wrong] = replace(pairs[wrong], T_a_b=se3.retract(pairs[wrong].T_a_b, np.array([0.2, 0, 0, 0, 0, 0.2])))
    along_tree, other = (
        solve_hypergraph(initialize_rig("lidar", pairs, s, rng), pairs, seen, settings=Settings()).T_root_sensor
        for s in ("tree", start)
    )
    for name in along_tree:
        np.testing.assert_allclose(other[name], along_tree[name], atol=1e-4)


def test_filtering_keeps_disturbed_captures_out() -> None:
    truth, seen, pairs, tree = world(4, moved=6)
    filtered = solve_hypergraph(tree, pairs, seen, settings=Settings())
    unfiltered = solve_hypergraph(tree, pairs, seen, keep="none", settings=Settings())
    errors = [
        np.mean([np.linalg.norm(se3.difference(j.T_root_sensor[n], truth[n])[:3]) for n in truth if n != "lidar"])
        for j in (filtered, unfiltered)
    ]
    assert errors[0] < 0.004
    assert errors[1] > 3 * errors[0]


def test_the_graph_error_falls_from_the_tree_to_the_solution() -> None:
    _, seen, pairs, tree = world(5)
    start = solve_hypergraph(tree, pairs, seen, optimize=False, settings=Settings())
    assert solve_hypergraph(tree, pairs, seen, settings=Settings()).graph_error < start.graph_error


def test_the_root_is_known_exactly() -> None:
    _, seen, pairs, tree = world(6)
    joint = solve_hypergraph(tree, pairs, seen, settings=Settings())
    np.testing.assert_array_equal(joint.T_root_sensor["lidar"], np.eye(4))
    np.testing.assert_array_equal(covariances(joint)["lidar"], np.zeros((6, 6)))


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_covariance_grows_with_noise_that_detections_did_not_state(scale: float) -> None:
    """The same data, claimed to be three times as sharp as they are, must not give a sharper result."""
    truth, seen, pairs, tree = world(7)
    claimed = {
        name: {
            i: tuple(replace(d, covariance=d.covariance / scale**2) for d in found)
            for i, found in by_capture.items()
        }
        for name, by_capture in seen.items()
    }
    joint = solve_hypergraph(tree, pairs, claimed, settings=Settings())
    assert nees(joint, truth).mean() / 6 < 2.5
