"""Priors and rigid groups: their effect, and their files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bundles_with_priors import EXACT, PAIR, group_of, grouped, with_prior
from calgraph.config import Rig
from calgraph.errors import InputError
from calgraph.geometry import se3
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.graph.spanning_tree import SpanningTree
from calgraph.result import read_extrinsics
from calgraph.result.extrinsics_file import PriorFile
from calgraph.rig.bundle.bundle_solver import minimize_bundle
from calgraph.rig.bundle.covariances import pose_covariance
from calgraph.rig.bundle.priors import (
    PosePrior,
    RigidFile,
    assign_bodies,
    attach_by_priors,
    resolve_prior_poses,
    without_priors,
)
from calgraph.rig.captures.detect import CaptureSet

SEEDS = 16


def test_a_group_stays_rigid(rng: np.random.Generator) -> None:
    group = group_of(EXACT, PAIR)
    T = grouped(EXACT.measured(rng), group).state.T_root_sensor
    given = [np.array(group.T_group_sensor[name]) for name in PAIR]
    np.testing.assert_allclose(se3.inverse(T[2]) @ T[3], se3.inverse(given[0]) @ given[1], atol=1e-12)


def test_a_group_makes_its_sensors_more_certain_and_more_right() -> None:
    group, errors = group_of(EXACT, PAIR), []
    for seed in range(SEEDS):
        bundle = EXACT.measured(np.random.default_rng(seed))
        alone, together = minimize_bundle(bundle, EXACT.truth), grouped(bundle, group)
        errors.append(
            [
                np.sum(se3.difference(s.state.T_root_sensor[2:], EXACT.truth.T_root_sensor[2:])[:, :3] ** 2)
                for s in (alone, together)
            ]
        )
        spread = [
            np.trace(pose_covariance(b, s.state, s.equations)[12:, 12:])
            for b, s in ((bundle, alone), (replace(bundle, body=assign_bodies(bundle.sensors, [group])), together))
        ]
        assert spread[1] < spread[0]
    separate, shared = np.sqrt(np.mean(errors, axis=0))
    assert shared < 0.85 * separate


def test_without_priors_all_sensors_with_views_are_free() -> None:
    bundle = EXACT.bundle
    blind = replace(
        bundle, views=(*bundle.views[:1], bundle.views[1].select(np.zeros(8, bool)), *bundle.views[2:])
    )
    np.testing.assert_array_equal(without_priors(with_prior(blind, 1, np.zeros(6))).body, [0, 0, 1, 2])


def test_bodies_are_numbered_from_that_of_the_root() -> None:
    groups = [group_of(EXACT, PAIR), group_of(EXACT, ("camera", "lidar"))]
    np.testing.assert_array_equal(assign_bodies(EXACT.bundle.sensors, groups), [0, 0, 1, 1])


# From files

POSES = """
- {parent: lidar, child: camera, translation: [1, 0, 0], rpy: [0, 0, 0]}
- {parent: camera, child: laser, translation: [0, 1, 0], rpy: [0, 0, 0]}
"""


@pytest.fixture
def rig() -> Rig:
    sensors = {name: {"kind": "lidar2d", "topic": f"/{name}"} for name in ("lidar", "camera", "laser", "rear")}
    target = {"kind": "board", "size": [1.0, 0.8], "family": "tag36h11", "tags": [{"id": 0, "size": 0.3}]}
    return Rig.model_validate({"root": "lidar", "target": target, "sensors": sensors})


@pytest.fixture
def captured(rig: Rig) -> CaptureSet:
    nothing = dict.fromkeys(rig.sensors, "")
    return CaptureSet(0.0, nothing, (), {name: {} for name in rig.sensors}, {}, {})


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "poses.yaml"
    path.write_text(POSES)
    return path


def test_priors_are_of_all_sensors_in_the_file(rig: Rig, captured: CaptureSet, file: Path) -> None:
    priors, groups = resolve_prior_poses(rig, captured, PriorFile(read_extrinsics(file), (0.01, 0.1)), [])
    assert [prior.sensor for prior in priors] == ["camera", "laser"]
    np.testing.assert_array_equal(np.array(priors[1].T_root_sensor)[:3, 3], [1, 1, 0])
    np.testing.assert_allclose(np.diag(priors[0].covariance), [1e-4, 1e-4, 1e-4, 1e-2, 1e-2, 1e-2])
    assert groups == ()


def test_exact_priors_fix_sensors_to_the_root(rig: Rig, captured: CaptureSet, file: Path) -> None:
    priors, groups = resolve_prior_poses(rig, captured, PriorFile(read_extrinsics(file), (0, 0)), [])
    assert priors == ()
    assert [list(group.T_group_sensor) for group in groups] == [["lidar", "camera", "laser"]]


@pytest.mark.parametrize(
    ("prior", "rigid", "message"),
    [
        (None, [("camera", "rear")], r"has no frame 'rear', nor one called rear .* has camera, laser, lidar"),
        (None, [("camera", "reer")], "there is no sensor reer to be in a rigid group; .* lidar, camera,"),
        (None, [("camera",)], "a rigid group needs two sensors at least, got camera"),
        (None, [("camera", "laser"), ("laser", "lidar")], "laser is in 2 rigid groups"),
        ((0, 0), [("camera", "laser")], "camera is in 2 rigid groups"),
        ("none", [], "states no covariance of camera"),
    ],
)
def test_inconsistent_priors_are_refused(
    rig: Rig, captured: CaptureSet, file: Path, prior: object, rigid: list[tuple[str, ...]], message: str
) -> None:
    poses = read_extrinsics(file)
    prior_file = None if prior is None else PriorFile(poses, None if prior == "none" else (0, 0))
    with pytest.raises(InputError, match=message):
        resolve_prior_poses(rig, captured, prior_file, [RigidFile(poses, sensors) for sensors in rigid])


@pytest.mark.parametrize("stddev", [(1e-150, 0.1), (1e-160, 1e-160), (0.01, 5e-324), (1e150, 0.1)])
def test_standard_deviations_whose_weights_overflow_are_refused(
    rig: Rig, captured: CaptureSet, file: Path, stddev: tuple[float, float]
) -> None:
    with pytest.raises(InputError, match="states no covariance of camera: give standard deviations"):
        resolve_prior_poses(rig, captured, PriorFile(read_extrinsics(file), stddev), [])


def prior_of(sensor: str, x: float) -> PosePrior:
    T = se3.pose(np.eye(3), np.array([x, 0, 0])).tolist()
    plain = {"sensor": sensor, "T_root_sensor": T, "covariance": np.eye(6).tolist(), "source": "prior"}
    return PosePrior.model_validate(plain)


def estimate(a: str, b: str, x: float) -> PairwiseEstimate:
    T = se3.pose(np.eye(3), np.array([x, 0, 0]))
    matches = np.zeros((1, 3), dtype=np.int64)
    return PairwiseEstimate(a, b, T, 1e4 * np.eye(6), matches, np.ones(1, bool), np.zeros(1))


def test_a_prior_connects_sensors_with_captures_in_common() -> None:
    root = SpanningTree("lidar", {}, {"lidar": np.eye(4)})
    tree = attach_by_priors(root, [estimate("camera", "laser", 2.0)], [prior_of("camera", 1.0)], [])
    assert dict(tree.parents) == {"camera": "lidar", "laser": "camera"}
    np.testing.assert_array_equal(tree.T_root_sensor["laser"][:3, 3], [3, 0, 0])


def test_a_group_connects_its_sensors_to_the_tree() -> None:
    tree = SpanningTree("lidar", {"laser": "lidar"}, {"lidar": np.eye(4), "laser": EXACT.truth.T_root_sensor[2]})
    tied = attach_by_priors(tree, [], [], [group_of(EXACT, PAIR)])
    assert tied.parents["laser_2"] == "laser"
    np.testing.assert_allclose(tied.T_root_sensor["laser_2"], EXACT.truth.T_root_sensor[3], atol=1e-12)


def test_connected_sensors_keep_their_place_in_the_tree() -> None:
    tree = SpanningTree("lidar", {"camera": "lidar"}, {"lidar": np.eye(4), "camera": np.eye(4)})
    assert attach_by_priors(tree, [], [prior_of("camera", 1.0)], []) is tree
