"""Reading poses that others wrote: our own exports come back, and what cannot be is refused with what there is."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calgraph.errors import InputError
from calgraph.geometry import Array, se3
from calgraph.result import Calibration, ExtrinsicsFile, export, read_extrinsics, save_calibration

FRAMES = {"lidar": "/velodyne", "camera": "camera_optical", "camera_2": "camera_2_optical", "laser": "laser_link"}

TURNED = Rotation.from_euler("xyz", [0.1, -0.2, 1.5]).as_matrix()
AS_LISTS = """
- {parent: base, child: a, translation: [1, 2, 3], rotation: [0, 0, 0, 1]}
- {frame_id: base, child_frame_id: b, translation: [0, 0, 1], rpy: [0.1, -0.2, 1.5]}
"""
AS_MAPPINGS = """
transforms:
- header: {frame_id: /base}
  child_frame_id: /a
  transform: {translation: {x: 1, y: 2, z: 3}, rotation: {x: 0, y: 0, z: 0, w: 1}}
---
transforms:
- header: {frame_id: base}
  child_frame_id: b
  transform: {translation: {x: 0, y: 0, z: 1}, rotation: {roll: 0.1, pitch: -0.2, yaw: 1.5}}
---
"""
CHAIN = """<?xml version="1.0"?>
<robot name="r">
  <joint name="mount" type="fixed"><parent link="base"/><child link="mast"/><origin xyz="0 0 2"/></joint>
  <joint name="left" type="fixed"><parent link="mast"/><child link="a"/><origin xyz="1 0 0"/></joint>
  <joint name="right" type="fixed"><parent link="base"/><child link="plate"/>
    <origin rpy="0 0 1.5707963267948966"/></joint>
  <joint name="deep" type="fixed"><parent link="plate"/><child link="b"/><origin xyz="1 0 0"/></joint>
  <joint name="neck" type="revolute"><parent link="mast"/><child link="head"/></joint>
</robot>
"""


def reading(path: Path, text: str) -> ExtrinsicsFile:
    path.write_text(text, encoding="utf-8")
    return read_extrinsics(path)


def between(poses: ExtrinsicsFile, a: str, b: str, frame_ids: dict[str, str]) -> Array:
    return poses.transform(poses.frame_of_sensor(a, frame_ids), poses.frame_of_sensor(b, frame_ids))


@pytest.mark.parametrize("format", ["tf", "urdf"])
def test_exports_come_back(calibration: Calibration, format: str, tmp_path: Path) -> None:
    poses = reading(tmp_path / "exported", export(calibration, format))
    for a in FRAMES:
        for b in FRAMES:
            np.testing.assert_allclose(between(poses, a, b, FRAMES), calibration.transform(a, b), atol=1e-11)


def test_a_calibration_comes_back_with_its_covariances(calibration: Calibration, tmp_path: Path) -> None:
    save_calibration(calibration, tmp_path / "calibration.yaml")
    poses = read_extrinsics(tmp_path / "calibration.yaml")
    np.testing.assert_allclose(
        between(poses, "camera_2", "laser", FRAMES), calibration.transform("camera_2", "laser"), atol=1e-12
    )
    assert poses.calibration is not None


def test_a_calibration_knows_its_frames_and_its_names(calibration: Calibration, tmp_path: Path) -> None:
    save_calibration(calibration, tmp_path / "calibration.yaml")
    poses = read_extrinsics(tmp_path / "calibration.yaml")
    assert poses.frames_of_sensors({"x": "camera_optical", "laser": "elsewhere", "y": "z"}) == {
        "x": "camera",
        "laser": "laser",
    }


@pytest.mark.parametrize("text", [AS_LISTS, AS_MAPPINGS])
def test_transforms_are_read_in_all_their_spellings(text: str, tmp_path: Path) -> None:
    poses = reading(tmp_path / "tf.yaml", text)
    expected = np.linalg.inv(se3.pose(np.eye(3), np.array([1.0, 2, 3]))) @ se3.pose(TURNED, np.array([0.0, 0, 1]))
    np.testing.assert_allclose(poses.transform("a", "b"), expected, atol=1e-12)


def test_links_of_a_urdf_may_be_nested_at_any_depth(tmp_path: Path) -> None:
    poses = reading(tmp_path / "robot.urdf", CHAIN)
    np.testing.assert_allclose(poses.transform("a", "b")[:3, 3], [-1, 1, -2], atol=1e-12)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no FIFOs")
def test_a_pipe_is_refused_before_it_is_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "poses")
    with pytest.raises(InputError, match="poses: is a pipe, and its content is read more than once"):
        read_extrinsics(tmp_path / "poses")


def test_a_movable_joint_between_sensors_is_refused(tmp_path: Path) -> None:
    poses = reading(tmp_path / "robot.urdf", CHAIN)
    with pytest.raises(InputError, match=r"joint 'neck' of .* is revolute, but lies between calibrated sensors"):
        poses.transform("a", "head")


def test_a_sensor_that_is_not_in_the_file_is_named_with_what_there_is(tmp_path: Path) -> None:
    poses = reading(tmp_path / "robot.urdf", CHAIN)
    with pytest.raises(InputError, match=r"has no frame 'optical', nor one called camera .* has a, b, base, head"):
        poses.frame_of_sensor("camera", {"a": "a", "camera": "optical"})


def test_a_file_that_knows_no_sensor_is_refused(tmp_path: Path) -> None:
    poses = reading(tmp_path / "robot.urdf", CHAIN)
    with pytest.raises(
        InputError, match="has none of the sensors' frames optical, nor their names camera; it has"
    ):
        poses.frames_of_sensors({"camera": "optical"})


def test_two_sensors_in_one_frame_are_refused(tmp_path: Path) -> None:
    poses = reading(tmp_path / "robot.urdf", CHAIN)
    with pytest.raises(InputError, match="left and right are both its frame 'a'"):
        poses.frames_of_sensors({"left": "a", "right": "/a"})


ENTITIES = '<!DOCTYPE robot [<!ENTITY a "aaaa">]><robot name="r"><joint name="&a;"/></robot>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (ENTITIES, "declares an entity, 'a'"),
        ("<robot>", "not valid XML"),
        ("a: 1", r"must be a calibration\.yaml .*, a URDF, or a list of transforms"),
        ("[]", "has no transforms"),
        ("format: calgraph/9", "format: must be calgraph/1"),
        ("[3]", r"transforms\[0\]: must be a mapping"),
        ("[{parent: a, translation: [0, 0, 0]}]", "needs the frame's parent .* it has parent, translation"),
        (
            "[{parent: a, child: b, translation: [0, 0]}]",
            r"translation: must be the numbers x, y, z, of 1e.08 or less, got \[0, 0\]",
        ),
        (
            "[{parent: a, child: b, translation: [0, 0, 0], rotation: [0, 0, 0, 2]}]",
            "must be a quaternion x, y, z, w of length 1, its length is 2",
        ),
        (
            "[{parent: a, child: b, translation: [0, 0, 0], rotation: {w: 1}}]",
            "rotation: must be the numbers x, y, z, w",
        ),
        (
            "[{parent: a, child: b, translation: [0, 0, 0], rpy: [0, 0, 0]},"
            " {parent: c, child: b, translation: [0, 0, 0], rpy: [0, 0, 0]}]",
            r"transforms\[1\]: 'b' has two parents, 'a' and 'c'",
        ),
    ],
)
def test_what_is_no_tree_of_poses_is_refused(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        reading(tmp_path / "poses", text)


def test_frames_that_nothing_connects_are_refused(tmp_path: Path) -> None:
    text = AS_LISTS + "- {parent: c, child: d, translation: [0, 0, 0], rpy: [0, 0, 0]}"
    with pytest.raises(InputError, match=r"frames 'a' and 'd' of .* are not connected"):
        reading(tmp_path / "tf.yaml", text).transform("a", "d")


@pytest.mark.parametrize("number", ["nan", "inf", "-inf", "1e300"])
@pytest.mark.parametrize("attribute", ["xyz", "rpy"])
def test_numbers_of_a_urdf_are_finite(number: str, attribute: str, tmp_path: Path) -> None:
    joint = f"""<robot name="r"><joint name="j" type="fixed"><origin {attribute}="0 {number} 0"/>
    <parent link="a"/><child link="b"/></joint></robot>"""
    with pytest.raises(
        InputError, match=f"joint 'j' of the URDF: {attribute} must be three numbers of 1e.08 or less"
    ):
        reading(tmp_path / "robot.urdf", joint)
