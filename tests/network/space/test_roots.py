"""Other roots than the LiDAR against which a network is solved: the floor, and 2-D scanners."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.errors import InputError
from calgraph.geometry import Array, plane, se3, so3
from calgraph.network.joint.planar_poses import NetworkPoses
from calgraph.network.space.floor_plane import level
from calgraph.network.space.observations import SpaceObservations, StaticPoints
from calgraph.network.space.roots import (
    change_root,
    express_in_reference,
    express_on_floor,
    list_references,
    spread_floor,
)
from calgraph.result import Calibration, Evidence, Pictures, SensorPose, Verdict

TILTS = [(0.3, 0.5), (-2.9, 0.2), (0.1, 1.55)]
"""Roll and pitch, the last with x near the vertical, rad."""


def tilted(roll: float, pitch: float) -> Array:
    """A levelled sensor 3 m over the floor."""
    R = so3.exp(np.array([0.0, pitch, 0.0])) @ so3.exp(np.array([roll, 0.0, 0.0]))
    return level(np.append(R[2], 3.0))


@pytest.mark.parametrize(("roll", "pitch"), TILTS)
def test_errors_of_the_floor_move_all_sensors_as_another_floor_does(roll: float, pitch: float) -> None:
    """A floor that is tilted by 1e-6 rad and 1e-6 m lower; linear theory against levelling again."""
    T_first = tilted(roll, pitch)
    T_second = T_first @ se3.pose(so3.exp(np.array([0.2, -0.4, 1.0])), np.array([4.0, -3.0, 0.5]))
    error = 1e-6 * np.array([0.7, -0.4, 1.0])
    moved = se3.pose(so3.exp(np.append(error[:2], 0.0)) @ T_first[:3, :3], np.array([0.0, 0.0, 3.0 + error[2]]))
    again = level(plane.transform(se3.inverse(moved), np.array([0.0, 0.0, 1.0, 0.0])))
    T_floor_first = again @ se3.inverse(T_first)
    found = np.concatenate([se3.difference(T_floor_first @ T, T) for T in (T_first, T_second)])
    T = np.stack([np.eye(4), se3.inverse(T_first) @ T_second])
    located = NetworkPoses(("first", "second"), T, np.zeros((12, 12)))
    spread = spread_floor(T_first, np.outer(error, error))
    on_floor = located.express_in("floor", T_first, spread)
    assert on_floor.names == ("floor", "first", "second")
    np.testing.assert_allclose(on_floor.T_root_scanner, [np.eye(4), T_first, T_second], atol=1e-12)
    np.testing.assert_allclose(on_floor.covariance[6:, 6:], np.outer(found, found), atol=1e-15)
    assert not on_floor.covariance[:6].any()


def network(T_floor_first: Array) -> tuple[Calibration, SpaceObservations]:
    """Three sensors rooted at the first, and what that measured."""
    rng = np.random.default_rng(0)
    T = [np.eye(4), *(se3.pose(so3.exp(rng.normal(size=3)), rng.normal(size=3)) for _ in range(2))]
    sensors = tuple(
        SensorPose(f"lidar_{k}", f"lidar_{k - 1}" if k else None, f"lidar_{k}", "lidar3d", one, Verdict("good"))
        for k, one in enumerate(T)
    )
    A = 0.01 * rng.normal(size=(12, 12))
    nothing = StaticPoints(np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=np.intp))
    observed = SpaceObservations(
        T_floor_first, np.diag([1e-6, 2e-6, 1e-4]), nothing, np.zeros(0, dtype=np.bool_), (), np.zeros((0, 2))
    )
    return Calibration("lidar_0", sensors, np.pad(A @ A.T, (6, 0))), observed


def test_relative_poses_are_the_same_with_the_floor_as_root_and_without_it() -> None:
    found, observed = network(tilted(0.3, 0.5))
    on_floor = express_on_floor(found, observed)
    assert [(one.name, one.parent) for one in on_floor.sensors][:2] == [("floor", None), ("lidar_0", "floor")]
    np.testing.assert_allclose(on_floor["lidar_0"].T_root_sensor, observed.T_floor_sensor)
    assert on_floor["lidar_0"].covariance[2, 2] == pytest.approx(1e-4)
    assert on_floor["lidar_0"].covariance[0, 0] == 0.0
    np.testing.assert_allclose(on_floor.transform("lidar_1", "lidar_2"), found.transform("lidar_1", "lidar_2"))
    back = express_in_reference(on_floor, "lidar_0")
    assert [(one.name, one.parent) for one in back.sensors] == [(one.name, one.parent) for one in found.sensors]
    np.testing.assert_allclose(back.joint_covariance, found.joint_covariance, atol=1e-12)


def test_another_root_changes_no_relative_pose_and_turns_the_tree_round() -> None:
    """lidar_2 is behind lidar_1: each becomes the parent of the one before."""
    found, _ = network(tilted(0.3, 0.5))
    T_plan_root, T_initial = tilted(-0.2, 0.1), se3.pose(so3.exp(np.array([0.0, 0.1, 0.2])), np.ones(3))
    initial = {"lidar_0": np.eye(4), "lidar_2": T_initial}
    found = replace(found, pictures=Pictures(T_plan_root=T_plan_root), evidence=Evidence(initial_poses=initial))
    changed = change_root(found, "lidar_2")
    assert changed.root == "lidar_2"
    assert [(one.name, one.parent) for one in changed.sensors] == [
        ("lidar_2", None), ("lidar_0", "lidar_1"), ("lidar_1", "lidar_2"),
    ]  # fmt: skip
    for a, b in (("lidar_0", "lidar_1"), ("lidar_1", "lidar_2"), ("lidar_2", "lidar_0")):
        np.testing.assert_allclose(changed.transform(a, b), found.transform(a, b), atol=1e-12)
        np.testing.assert_allclose(changed.covariance(a, b), found.covariance(a, b), atol=1e-12)
    np.testing.assert_allclose(
        changed.pictures.T_plan_root @ changed["lidar_1"].T_root_sensor,
        T_plan_root @ found["lidar_1"].T_root_sensor,
    )
    np.testing.assert_allclose(changed.evidence.initial_poses["lidar_2"], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(changed.evidence.initial_poses["lidar_0"], se3.inverse(T_initial), atol=1e-12)
    back = change_root(changed, "lidar_0")
    assert [(one.name, one.parent) for one in back.sensors] == [
        ("lidar_0", None), ("lidar_2", "lidar_1"), ("lidar_1", "lidar_0"),
    ]  # fmt: skip
    np.testing.assert_allclose(back["lidar_2"].covariance, found["lidar_2"].covariance, atol=1e-12)
    assert change_root(found, "lidar_0") is found


def rig_of(root: str, *kinds: str) -> Rig:
    sensors = {f"{kind}_{k}": {"kind": kind, "topic": f"/{k}"} for k, kind in enumerate(kinds)}
    return Rig.model_validate({"root": root, "target": {"kind": "people"}, "sensors": sensors})


def test_a_lidar_that_earlier_poses_have_is_the_reference() -> None:
    """It is the root itself if that is a LiDAR, and the first of rig.yaml if that is the floor."""
    found, _ = network(tilted(0.3, 0.5))
    kinds = ("lidar2d", "lidar3d", "lidar3d")
    assert list_references(rig_of("lidar2d_0", *kinds), None) == ["lidar3d_1", "lidar3d_2"]
    assert list_references(rig_of("lidar3d_2", *kinds), None) == ["lidar3d_2"]
    assert list_references(rig_of("floor", *kinds), None) == ["lidar3d_1"]
    names = ("lidar2d_0", "lidar3d_2", "lidar3d_3")
    sensors = [replace(one, name=name, parent=None) for one, name in zip(found.sensors, names, strict=True)]
    earlier = replace(found, root="lidar2d_0", sensors=tuple(sensors))
    assert list_references(rig_of("lidar2d_0", *kinds), earlier) == ["lidar3d_2"]
    with pytest.raises(InputError, match=r"`extend`: has no lidar3d_1, the first 3-D LiDAR .*first: lidar3d_2$"):
        list_references(rig_of("floor", *kinds), earlier)
    with pytest.raises(InputError, match=r"`extend`: has none of lidar3d_1 where it was"):
        list_references(rig_of("lidar2d_0", *kinds[:2]), earlier)


@pytest.mark.parametrize(
    ("kind", "target"), [("lidar2d", {"kind": "people"}), ("lidar3d", {"kind": "surroundings"})]
)
def test_the_floor_is_the_root_of_networks_of_lidars_only(kind: str, target: dict[str, str]) -> None:
    sensors = {"one": {"kind": kind, "topic": "/one"}, "two": {"kind": kind, "topic": "/two"}}
    with pytest.raises(ValueError, match=r"'floor' needs 3-D LiDARs in target: \{kind: people\}"):
        Rig.model_validate({"root": "floor", "target": target, "sensors": sensors})
