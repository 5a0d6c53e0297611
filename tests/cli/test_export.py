"""calgraph export: every format, from a real result."""

import ast
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from ruamel.yaml import YAML
from typer.testing import Result

from calgraph.result import BaseFrame, Verdict, load_calibration, read_extrinsics, save_calibration
from calgraph.result.sensor_pose import Grade

Run = Callable[..., Result]


@pytest.fixture
def out(calibrated: tuple[Path, Result]) -> Path:
    return calibrated[0]


def test_the_launch_file_is_python(run: Run, out: Path) -> None:
    text = run("export", out, "--force", "--format", "launch").stdout
    assert [node.name for node in ast.parse(text).body if isinstance(node, ast.FunctionDef)] == [
        "generate_launch_description"
    ]


def test_a_calibration_yaml_serves_as_well_as_its_folder(run: Run, out: Path) -> None:
    texts = [run("export", path, "-f", "tf", "--force").stdout for path in (out, out / "calibration.yaml")]
    assert texts[0] == texts[1]


def test_tf_has_a_transform_for_each_sensor_but_the_root(run: Run, out: Path) -> None:
    content = YAML(typ="safe").load(run("export", out, "-f", "tf", "--force").stdout)
    assert {entry["child_frame_id"] for entry in content["transforms"]} == {"camera_optical", "laser_front"}


def test_kalibr_takes_the_intrinsics_from_the_resolved_rig_beside_the_result(run: Run, out: Path) -> None:
    content = YAML(typ="safe").load(run("export", out, "-f", "kalibr", "--force").stdout)
    assert content["cam0"]["resolution"] == [480, 360]


def test_a_given_rig_goes_before_the_one_beside_the_result(run: Run, out: Path, simulated: Path) -> None:
    result = run("export", out, "--force", "-f", "kalibr", "--rig", simulated / "rig.yaml")
    assert result.exit_code == 2
    assert "the intrinsics of 'camera' are not known" in result.stderr


def test_json_holds_every_sensor(run: Run, out: Path) -> None:
    assert set(json.loads(run("export", out, "-f", "json").stdout)["sensors"]) == {
        "lidar",
        "camera",
        "laser_front",
    }


def test_a_new_urdf_has_a_link_for_each_frame(run: Run, out: Path) -> None:
    robot = ElementTree.fromstring(run("export", out, "-f", "urdf", "--force").stdout.encode())
    assert {link.get("name") for link in robot.iter("link")} == {"lidar", "camera_optical", "laser_front"}


def test_a_given_urdf_is_corrected_in_a_file(run: Run, out: Path, tmp_path: Path) -> None:
    new = run("export", out, "-f", "urdf", "--force").stdout
    origin = new[new.index("<origin") : new.index("/>", new.index("<origin")) + 2]
    (tmp_path / "old.urdf").write_text(new.replace(origin, '<origin xyz="9 9 9" rpy="0 0 0"/>'))
    result = run(
        "export", out, "--force", "-f", "urdf", "--urdf", tmp_path / "old.urdf", "-o", tmp_path / "new.urdf"
    )
    assert (result.exit_code, result.stdout) == (0, "")
    assert origin in (tmp_path / "new.urdf").read_text()


def test_poses_that_are_not_good_are_refused_by_name(run: Run, out: Path, tmp_path: Path) -> None:
    result = run("export", out, "-f", "tf", "-o", tmp_path / "tf.yaml")
    assert (result.exit_code, (tmp_path / "tf.yaml").exists()) == (1, False)
    advice = "; give --force to export it as it is, or --only good to leave it out"
    assert re.search(f"calgraph: laser_front is weak: .*{advice}", result.stderr)


def graded(out: Path, folder: Path, camera: Grade, laser_front: Grade) -> Path:
    """The calibration.yaml with other verdicts."""
    found = load_calibration(out / "calibration.yaml")
    verdicts = {"camera": Verdict(camera, "focal length"), "laser_front": Verdict(laser_front, "height is loose")}
    sensors = tuple(replace(s, verdict=verdicts.get(s.name, s.verdict)) for s in found.sensors)
    save_calibration(replace(found, sensors=sensors), folder / "calibration.yaml")
    return folder / "calibration.yaml"


def test_poses_that_are_not_good_are_left_out_by_name(run: Run, out: Path, tmp_path: Path) -> None:
    result = run("export", graded(out, tmp_path, "good", "weak"), "-f", "tf", "--only", "good")
    content = YAML(typ="safe").load(result.stdout)
    assert [entry["child_frame_id"] for entry in content["transforms"]] == ["camera_optical"]
    assert result.stderr == "Left out: laser_front is weak: height is loose\n"


def test_sensors_without_a_pose_are_named_as_left_out(run: Run, out: Path, tmp_path: Path) -> None:
    file = graded(out, tmp_path, "good", "good")
    found = load_calibration(file)
    evidence = replace(found.evidence, unconnected={"sonar": "it detected no board"})
    save_calibration(replace(found, evidence=evidence), file)
    result = run("export", file, "-f", "tf", "--only", "good")
    assert result.stderr == "Left out: sonar is not connected: it detected no board\n"


def test_there_is_nothing_to_export_where_no_pose_is_good(run: Run, out: Path, tmp_path: Path) -> None:
    file = graded(out, tmp_path, "weak", "unobservable")
    result = run("export", file, "-f", "tf", "--only", "good", "-o", tmp_path / "tf.yaml")
    assert (result.exit_code, (tmp_path / "tf.yaml").exists()) == (1, False)
    assert result.stderr.splitlines() == [
        "Left out: camera is weak: focal length",
        "Left out: laser_front is unobservable: height is loose",
        "calgraph: there is nothing to export: no pose is good",
    ]


def test_only_and_force_contradict(run: Run, out: Path) -> None:
    result = run("export", out, "-f", "tf", "--only", "good", "--force")
    assert result.exit_code == 2
    assert result.stderr == "calgraph: --only: goes without --force, which exports all poses\n"


URDF = """<robot name="bot">
  <joint name="mount" type="fixed"><parent link="base"/><child link="lidar"/></joint>
  <joint name="case" type="fixed"><parent link="base"/><child link="camera_link"/></joint>
  <joint name="image" type="fixed"><origin rpy="-1.57079632679 0 -1.57079632679"/>
    <parent link="camera_link"/><child link="camera_optical"/></joint>
</robot>
"""


def test_the_joint_of_a_camera_can_be_chosen(run: Run, out: Path, tmp_path: Path) -> None:
    (tmp_path / "robot.urdf").write_text(URDF)
    new, calibration = tmp_path / "new.urdf", load_calibration(out / "calibration.yaml")
    result = run(
        "export",
        out,
        "-f",
        "urdf",
        "--force",
        "--urdf",
        tmp_path / "robot.urdf",
        "--joint",
        "camera=case",
        "-o",
        new,
    )
    assert result.exit_code == 0, result.output
    np.testing.assert_allclose(
        read_extrinsics(new).transform("lidar", "camera_optical"), calibration["camera"].T_root_sensor, atol=1e-9
    )
    image = next(line for line in URDF.splitlines() if '"image"' in line)
    assert image in new.read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--joint", "camera=case"], "--joint: goes with --urdf, whose joints it names"),
        (["--urdf", "URDF", "--joint", "case"],
         "--joint: must be SENSOR=JOINT, such as camera=camera_joint, got 'case'"),
        (["--urdf", "URDF", "--joint", "camera=case", "--joint", "camera=image"],
         "--joint: camera has case already, one sensor has one joint"),
        (["--urdf", "URDF", "--joint", "camera=cas"], "URDF: the URDF has no joint 'cas'; did you mean 'case'?"),
    ],
)  # fmt: skip
def test_a_joint_that_cannot_be_chosen_is_refused(
    run: Run, out: Path, tmp_path: Path, arguments: list[str], message: str
) -> None:
    urdf = tmp_path / "robot.urdf"
    urdf.write_text(URDF)
    given = [str(urdf) if one == "URDF" else one for one in arguments]
    result = run("export", out, "-f", "urdf", "--force", *given)
    assert result.exit_code == 2
    assert result.stderr.splitlines()[-1] == f"calgraph: {re.sub('^URDF', str(urdf), message)}"


def test_an_option_of_another_format_is_refused(run: Run, out: Path) -> None:
    result = run("export", out, "-f", "tf", "--urdf", "robot.urdf")
    assert (result.exit_code, result.stderr) == (2, "calgraph: --urdf: goes with --format urdf, got --format tf\n")


def test_an_unknown_format_is_bad_usage_and_the_available_ones_are_named(run: Run, out: Path) -> None:
    result = run("export", out, "-f", "xml")
    assert result.exit_code == 2
    assert "kalibr" in result.stderr


def test_a_folder_without_a_calibration_is_named(run: Run, tmp_path: Path) -> None:
    result = run("export", tmp_path, "-f", "tf")
    assert result.exit_code == 2
    expected = f"{tmp_path}: has no calibration.yaml; give the folder that calibrate wrote"
    assert result.stderr == f"calgraph: {expected}\n"


def test_a_missing_urdf_is_named(run: Run, out: Path, tmp_path: Path) -> None:
    result = run("export", out, "--force", "-f", "urdf", "--urdf", tmp_path / "none.urdf")
    assert result.exit_code == 2
    assert result.stderr == f"calgraph: {tmp_path / 'none.urdf'}: does not exist; check the path\n"


@pytest.mark.parametrize(
    ("format", "line"),
    [
        ("launch", "to publish it: ros2 launch"),
        ("tf", "to publish it: ros2 topic pub --qos-durability transient_local /tf_static"),
    ],
)
def test_the_line_that_publishes_a_file_is_printed(
    run: Run, out: Path, tmp_path: Path, format: str, line: str
) -> None:
    file = tmp_path / "sensors"
    result = run("export", out, "-f", format, "--force", "-o", file)
    assert result.stderr.startswith(f"Wrote {file}; {line}")
    assert str(file) in result.stderr.partition(line)[2]


@pytest.mark.parametrize("arguments", [["-f", "json"], ["-f", "kalibr"], ["-f", "urdf", "--urdf", "robot.urdf"]])
def test_parents_are_for_formats_with_a_tree(run: Run, out: Path, arguments: list[str]) -> None:
    result = run("export", out, "--force", *arguments, "--parents", "tree")
    assert result.exit_code == 2
    assert result.stderr == "calgraph: --parents: goes with --format launch, tf, and urdf without --urdf\n"


def test_a_urdf_that_cannot_be_read_is_named(run: Run, out: Path, tmp_path: Path) -> None:
    (tmp_path / "robot.urdf").write_text("<robot><link")
    done = run("export", out, "-f", "urdf", "--force", "--urdf", tmp_path / "robot.urdf")
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr.startswith(f"calgraph: {tmp_path / 'robot.urdf'}: the URDF is not valid XML")


def test_camera_info_is_that_of_the_resolved_rig(run: Run, out: Path) -> None:
    content = YAML(typ="safe").load(run("export", out, "-f", "camera_info", "--force").stdout)
    assert (content["camera_name"], content["image_width"], content["image_height"]) == ("camera", 480, 360)
    assert content["camera_matrix"]["data"][0] == pytest.approx(240, rel=0.01)


def test_corrections_are_of_all_sensors_and_of_a_distance(run: Run, out: Path) -> None:
    text = run("export", out, "-f", "corrections", "--force", "--distance", "4.5").stdout
    content = YAML(typ="safe").load(text)["sensors"]
    assert {name: entry["distance"] for name, entry in content.items()} == {
        "lidar": 4.5,
        "camera": 4.5,
        "laser_front": 4.5,
    }
    assert np.shape(content["camera"]["covariance"]) == (9, 9)


def test_a_distance_is_refused_with_other_formats(run: Run, out: Path) -> None:
    result = run("export", out, "-f", "tf", "--distance", "4.5")
    assert result.exit_code == 2
    assert "--distance: goes with --format corrections" in result.stderr


@pytest.mark.parametrize(("grade", "code"), [("good", 0), ("weak", 1)])
def test_a_weak_frame_of_a_vehicle_is_refused(
    run: Run, out: Path, tmp_path: Path, grade: Grade, code: int
) -> None:
    calibration = load_calibration(out / "calibration.yaml")
    good = (replace(sensor, verdict=Verdict("good")) for sensor in calibration.sensors)
    base = BaseFrame("base_link", "rear", Verdict(grade, "y is open"), np.eye(4), np.eye(6))
    save_calibration(replace(calibration, sensors=tuple(good), base=base), tmp_path / "calibration.yaml")
    result = run("export", tmp_path, "-f", "urdf")
    assert result.exit_code == code
    assert ("base_link is weak: y is open; give --force" in result.stderr) == (grade == "weak")
    assert ('<link name="base_link"/>' in result.stdout) == (grade == "good")
    left_out = run("export", tmp_path, "-f", "urdf", "--only", "good")
    assert ("Left out: base_link is weak: y is open" in left_out.stderr) == (grade == "weak")
