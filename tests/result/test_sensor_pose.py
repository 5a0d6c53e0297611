"""The vehicle's frame in result files and exports."""

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from ruamel.yaml import YAML

from calgraph.errors import InputError
from calgraph.geometry import Array, se3, so3
from calgraph.result import BaseFrame, Calibration, SensorPose, Verdict, export, load_calibration, save_calibration
from calgraph.result.extrinsics_file import read_extrinsics
from calgraph.result.sensor_pose import Grade

T_FRONT_REAR = se3.pose(so3.exp(np.array([0.0, 0.1, 3.0])), np.array([-1.0, 0.1, 0.2]))


def base_frame(y: float = np.nan, grade: Grade = "good") -> BaseFrame:
    T = se3.pose(so3.exp(np.array([0.1, 0.2, 0.3])), np.array([0.5, y, 0.8]))
    covariance = np.diag([1e-5, 0.0, 2e-5, 1e-6, 1e-6, 3e-6])
    covariance[1], covariance[:, 1] = np.nan, np.nan
    return BaseFrame("base_link", "rear", Verdict(grade, "" if grade == "good" else "why"), T, covariance)


def calibrated(base: BaseFrame | None) -> Calibration:
    poses = {"front": np.eye(4), "rear": T_FRONT_REAR}
    sensors = tuple(
        SensorPose(name, None if name == "front" else "front", f"{name}_link", "lidar3d", T, Verdict("good"))
        for name, T in poses.items()
    )
    return Calibration("front", sensors, np.diag([*[0.0] * 6, *[1e-6] * 6]), base=base)


def test_it_comes_back_from_the_file(tmp_path: Path) -> None:
    before = base_frame()
    save_calibration(calibrated(before), tmp_path / "calibration.yaml")
    content = YAML().load(tmp_path / "calibration.yaml")["base"]
    assert content["translation"] == [0.5, None, 0.8]
    assert content["covariance"][1] == [None] * 6
    assert content["verdict"] == {"grade": "good"}
    after = load_calibration(tmp_path / "calibration.yaml").base
    assert after is not None
    np.testing.assert_allclose(after.T_base_root, before.T_base_root, atol=1e-12)
    np.testing.assert_allclose(after.covariance, before.covariance, atol=1e-14)
    assert (after.frame, after.axle, after.verdict) == ("base_link", "rear", Verdict("good"))


def test_one_that_is_not_known_has_a_verdict_only(tmp_path: Path) -> None:
    unknown = BaseFrame("base_link", "middle", Verdict("unobservable", "no floor"))
    save_calibration(calibrated(unknown), tmp_path / "calibration.yaml")
    content = YAML().load(tmp_path / "calibration.yaml")["base"]
    assert set(content) == {"frame", "axle", "verdict"}
    after = load_calibration(tmp_path / "calibration.yaml").base
    assert after is not None
    assert not after.known
    assert "base_link" not in export(calibrated(after), "urdf")


def test_a_file_needs_all_of_its_numbers(tmp_path: Path) -> None:
    file = tmp_path / "calibration.yaml"
    save_calibration(calibrated(base_frame()), file)
    file.write_text(file.read_text().replace("  translation: [0.5, null, 0.8]\n", "", 1))
    with pytest.raises(InputError, match="must have translation, rotation and covariance, or none of them"):
        load_calibration(file)


def pose_of(joint: ElementTree.Element) -> Array:
    from calgraph.geometry.so3 import from_roll_pitch_yaw

    origin = joint.find("origin")
    assert origin is not None
    xyz, rpy = (np.array(origin.attrib[key].split(), dtype=float) for key in ("xyz", "rpy"))
    return se3.pose(from_roll_pitch_yaw(*rpy), xyz)


@pytest.mark.parametrize(("y", "expected"), [(np.nan, 0.0), (0.12, 0.12)])
def test_exports_are_rooted_at_it(y: float, expected: float) -> None:
    text = export(calibrated(base_frame(y)), "urdf")
    robot = ElementTree.fromstring(text)
    assert [link.attrib["name"] for link in robot.iter("link")] == ["base_link", "front_link", "rear_link"]
    first = robot.findall("joint")[0]
    assert first.attrib["name"] == "base_link_to_front_link"
    np.testing.assert_allclose(pose_of(first)[:3, 3], [0.5, expected, 0.8])
    assert ("y of front in it: 0, as not measured" in text) == np.isnan(y)
    for format in ("tf", "launch"):
        assert "base_link" in export(calibrated(base_frame(y)), format)


def test_transforms_of_tf_give_the_same_poses(tmp_path: Path) -> None:
    (tmp_path / "tf.yaml").write_text(export(calibrated(base_frame(0.1)), "tf"))
    T = read_extrinsics(tmp_path / "tf.yaml").transform("base_link", "rear_link")
    np.testing.assert_allclose(T, base_frame(0.1).T_base_root @ T_FRONT_REAR, atol=1e-9)


def test_only_good_leaves_a_weak_one_out() -> None:
    assert "base_link" not in export(calibrated(base_frame(grade="weak")), "urdf", only="good")
    assert "base_link" in export(calibrated(base_frame(0.1)), "urdf", only="good")


def test_a_sensor_of_the_same_frame_is_refused() -> None:
    same = replace(base_frame(), frame="rear_link")
    with pytest.raises(InputError, match="'rear_link' is the vehicle's frame, and that of a sensor, too"):
        export(calibrated(same), "tf")


URDF = """<robot name="r"><link name="base_link"/><link name="front_link"/><link name="rear_link"/>
<joint name="a" type="fixed"><parent link="base_link"/><child link="front_link"/>
<origin xyz="0.4 0.07 0.7" rpy="0 0 0"/></joint>
<joint name="b" type="fixed"><parent link="base_link"/><child link="rear_link"/>
<origin xyz="-0.4 0.07 0.7" rpy="0 0 3"/></joint></robot>"""


def test_a_urdf_gets_the_pose_of_the_root_and_keeps_what_is_not_measured() -> None:
    robot = ElementTree.fromstring(export(calibrated(base_frame()), "urdf", urdf=URDF))
    front, rear = map(pose_of, robot.findall("joint"))
    np.testing.assert_allclose(front[:3, 3], [0.5, 0.07, 0.8], atol=1e-9)
    np.testing.assert_allclose(front[:3, :3], base_frame().T_base_root[:3, :3], atol=1e-9)
    np.testing.assert_allclose(se3.inverse(front) @ rear, T_FRONT_REAR, atol=1e-9)


def test_a_scanner_keeps_its_height_and_tilt_in_a_urdf() -> None:
    T = se3.pose(so3.exp(np.array([0.0, 0.0, 0.2])), np.array([0.5, np.nan, np.nan]))
    flat = replace(base_frame(), T_base_root=T)
    robot = ElementTree.fromstring(
        export(calibrated(flat), "urdf", urdf=URDF.replace('0.7" rpy="0 0 0', '0.7" rpy="0.1 0 0'))
    )
    front = pose_of(robot.findall("joint")[0])
    np.testing.assert_allclose(front[:3, 3], [0.5, 0.07, 0.7], atol=1e-9)
    np.testing.assert_allclose(front[:3, :3], T[:3, :3] @ so3.exp(np.array([0.1, 0.0, 0.0])), atol=1e-9)


def test_json_has_null_for_what_is_not_measured() -> None:
    import json

    base = json.loads(export(calibrated(base_frame()), "json"))["base"]
    assert base["T_base_root"][1][3] is None
    assert base["covariance"][1] == [None] * 6
    assert base["verdict"]["grade"] == "good"
