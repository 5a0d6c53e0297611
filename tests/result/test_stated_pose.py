"""Heights and tilts that rig.yaml states, in exports of networks, which do not measure them."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from calgraph.geometry import Array, se2
from calgraph.result import (
    Calibration,
    SensorPose,
    StatedPose,
    Verdict,
    export,
    join_covariances,
    load_calibration,
    save_calibration,
)
from calgraph.result.exports.frames import apply_stated_poses

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
PLANAR = se2.pose(np.array([0.0, 1.1, -2.0]), np.array([[0.0, 0.0], [4.0, 1.0], [2.0, -3.0]]))
"""Upright poses of north, east and west, the frame of north being that of the floor."""


def network(stated: Mapping[str, StatedPose] | None = None, inverted: str = "") -> Calibration:
    """Poses as a network measures them: in the frame of the root, which may be upside-down."""
    names = ("north", "east", "west")
    T = [T_k @ (FLIP if name == inverted else np.eye(4)) for name, T_k in zip(names, lifted(), strict=True)]
    unmeasured = np.diag([1e-4, 1e-4, *[np.nan] * 3, 1e-6])
    sensors = tuple(
        SensorPose(name, None if k == 0 else "north", name, "lidar2d", np.linalg.inv(T[0]) @ T[k], Verdict("good"),
                   stated=(stated or {}).get(name))
        for k, name in enumerate(names)
    )  # fmt: skip
    return Calibration("north", sensors, join_covariances([np.zeros((6, 6)), unmeasured, unmeasured]))


def lifted() -> Array:
    return se2.to_se3(PLANAR)


def place(k: int, height: float, roll: float, pitch: float, inverted: bool = False) -> Array:
    """The pose on the floor from the definition: yaw, pitch and roll about moving axes, from z upwards."""
    T = np.eye(4)
    yaw = np.arctan2(PLANAR[k, 1, 0], PLANAR[k, 0, 0])
    T[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll + (np.pi if inverted else 0.0)]).as_matrix()
    T[:3, 3] = [*PLANAR[k, :2, 2], height]
    return T


@pytest.mark.parametrize("inverted", ["", "north", "east"])
def test_poses_have_the_stated_heights_and_tilts(inverted: str) -> None:
    values = {"north": (0.3, 0.02, -0.01), "east": (2.1, -0.03, 0.04), "west": (0.5, 0.0, 0.0)}
    stated = {name: StatedPose(*v, inverted=name == inverted) for name, v in values.items()}
    found = apply_stated_poses(network(stated, inverted))
    T = [place(k, *v, inverted=name == inverted) for k, (name, v) in enumerate(values.items())]
    for k, sensor in enumerate(found.sensors):
        np.testing.assert_allclose(sensor.T_root_sensor, np.linalg.inv(T[0]) @ T[k], atol=1e-12)


def test_heights_count_where_both_are_stated() -> None:
    found = apply_stated_poses(network({"east": StatedPose(2.1, roll=0.01), "west": StatedPose(0.5)}))
    assert [sensor.T_root_sensor[2, 3] for sensor in found.sensors] == [0.0, 0.0, 0.0]
    found = apply_stated_poses(network({"north": StatedPose(0.3), "east": StatedPose(2.1), "west": StatedPose()}))
    assert [sensor.T_root_sensor[2, 3] for sensor in found.sensors] == pytest.approx([0.0, 1.8, 0.0])


def test_poses_remain_planar_where_nothing_is_stated() -> None:
    found = network()
    assert apply_stated_poses(found) is found


@pytest.mark.parametrize("format", ["launch", "tf", "urdf"])
def test_exports_comment_on_what_was_not_measured(format: str) -> None:
    assert "were not measured: they are 0, as rig.yaml does not state them" in export(network(), format)
    stated = {"north": StatedPose(0.3), "east": StatedPose(2.1)}
    text = export(network(stated), format)
    assert "were not measured: they are as rig.yaml states them, or 0." in text
    assert "1.8" in text


def test_stated_poses_are_read_back(tmp_path: Path) -> None:
    stated = {"north": StatedPose(), "east": StatedPose(2.1, 0.01, -0.02, inverted=True)}
    path = tmp_path / "calibration.yaml"
    save_calibration(network(stated), path)
    read = load_calibration(path)
    assert {sensor.name: sensor.stated for sensor in read.sensors} == {**stated, "west": None}
    np.testing.assert_allclose(read["east"].T_root_sensor, network()["east"].T_root_sensor, atol=1e-12)
    assert json.loads(export(read, "json"))["sensors"]["east"]["stated"]["height"] == 2.1


def urdf() -> str:
    """A URDF with all scanners on one base, of which east is 2.5 m above north, and tilted."""
    joints = "".join(
        f'<joint name="{child}" type="fixed"><parent link="base"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{angles}"/></joint>'
        for child, xyz, angles in (
            ("north", "1 1 0.5", "0 0 1"),
            ("east", "9 9 3", "0.1 0.2 0.3"),
            ("west", "2 2 0.5", "0 0 0"),
        )
    )
    return f'<robot name="r"><link name="base"/>{joints}</robot>'


def read_origin(text: str, child: str) -> tuple[Array, Array]:
    """Position and roll, pitch, yaw of a link on the base."""
    origin = text.split(f'<joint name="{child}"')[1].split("<origin ")[1].split("/>", maxsplit=1)[0]
    xyz, rpy = (np.array(part.split(), dtype=float) for part in origin.split('"')[1::2])
    return xyz, rpy


def test_a_urdf_keeps_heights_and_tilts_that_are_not_stated() -> None:
    xyz, rpy = read_origin(export(network(), "urdf", urdf=urdf()), "east")
    x, y = PLANAR[1, :2, 2]
    np.testing.assert_allclose(xyz, [1 + x * np.cos(1) - y * np.sin(1), 1 + x * np.sin(1) + y * np.cos(1), 3.0])
    np.testing.assert_allclose(rpy, [0.1, 0.2, 1 + 1.1], atol=1e-9)


def test_a_urdf_gets_heights_and_tilts_that_are_stated() -> None:
    stated = {"north": StatedPose(0.3), "east": StatedPose(2.1, roll=0.05)}
    xyz, rpy = read_origin(export(network(stated), "urdf", urdf=urdf()), "east")
    assert xyz[2] == pytest.approx(0.5 + 1.8)
    np.testing.assert_allclose(rpy, [0.05, 0.0, 1 + 1.1], atol=1e-9)


def test_a_scanner_that_is_the_other_way_up_loses_the_tilt_of_the_urdf() -> None:
    _, rpy = read_origin(export(network(inverted="east"), "urdf", urdf=urdf()), "east")
    np.testing.assert_allclose(Rotation.from_euler("xyz", rpy).as_matrix()[2], [0, 0, -1], atol=1e-9)


def test_tf_has_the_stated_rotation() -> None:
    stated = {"north": StatedPose(), "east": StatedPose(roll=0.05)}
    (east,) = (
        one["transform"]["rotation"]
        for one in YAML(typ="safe").load(export(network(stated), "tf"))["transforms"]
        if one["child_frame_id"] == "east"
    )
    rotation = Rotation.from_quat([east[axis] for axis in "xyzw"])
    np.testing.assert_allclose(rotation.as_euler("ZYX"), [1.1, 0.0, 0.05], atol=1e-9)
