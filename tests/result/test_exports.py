"""Exports, each read back with an independent reader (scipy's Rotation) and recomposed to poses in the root."""

import dataclasses
import json
import re
import sys
import types
import xml.etree.ElementTree as ET
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from calgraph.config import Rig
from calgraph.errors import CalibrationError, InputError
from calgraph.geometry import Array, se3, so3
from calgraph.result import Calibration, FloorView, Verdict, export
from calgraph.result.calibration import PriorErrors
from calgraph.result.exports import FORMATS
from calgraph.result.exports.frames import keep_good_poses
from calgraph.result.sensor_pose import Grade
from calgraph.sensors import CameraModel

Edges = dict[str, tuple[str, Array]]
"""Parent frame and T_parent_child by child frame."""


def matrix(rotation: Rotation, xyz: Any) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), [float(v) for v in xyz]
    return T


def read_tf(text: str) -> Edges:
    edges: Edges = {}
    for t in YAML(typ="safe").load(text)["transforms"]:
        q, v = t["transform"]["rotation"], t["transform"]["translation"]
        rotation = Rotation.from_quat([q["x"], q["y"], q["z"], q["w"]])
        edges[t["child_frame_id"]] = t["header"]["frame_id"], matrix(rotation, (v["x"], v["y"], v["z"]))
    return edges


def read_urdf(text: str) -> Edges:
    edges: Edges = {}
    for joint in ET.fromstring(text.encode()).findall("joint"):
        origin, parent, child = joint.find("origin"), joint.find("parent"), joint.find("child")
        assert parent is not None
        assert child is not None
        xyz = (origin.get("xyz", "0 0 0") if origin is not None else "0 0 0").split()
        rpy = (origin.get("rpy", "0 0 0") if origin is not None else "0 0 0").split()
        T = matrix(Rotation.from_euler("xyz", [float(v) for v in rpy]), xyz)
        edges[child.attrib["link"]] = parent.attrib["link"], T
    return edges


def read_launch(text: str) -> Edges:
    """Runs the launch file with stand-ins for ROS and collects the arguments of its nodes."""
    nodes: list[dict[str, Any]] = []
    launch, launch_ros, actions = (types.ModuleType(n) for n in ("launch", "launch_ros", "launch_ros.actions"))
    vars(launch)["LaunchDescription"] = list
    vars(actions)["Node"] = lambda **arguments: nodes.append(arguments)
    stand_ins = {"launch": launch, "launch_ros": launch_ros, "launch_ros.actions": actions}
    with pytest.MonkeyPatch.context() as patch:
        for name, module in stand_ins.items():
            patch.setitem(sys.modules, name, module)
        space: dict[str, Any] = {}
        exec(compile(text, "launch.py", "exec"), space)
        space["generate_launch_description"]()
    edges: Edges = {}
    for node in nodes:
        assert (node["package"], node["executable"]) == ("tf2_ros", "static_transform_publisher")
        a = dict(zip(node["arguments"][::2], node["arguments"][1::2], strict=True))
        rotation = Rotation.from_quat([float(a[f"--q{axis}"]) for axis in "xyzw"])
        edges[a["--child-frame-id"]] = a["--frame-id"], matrix(rotation, [a["--x"], a["--y"], a["--z"]])
    return edges


def pose_from(edges: Edges, base: str, frame: str) -> Array:
    """T_base_frame along the edges, up from both to the top."""

    def from_top(name: str) -> Array:
        T = np.eye(4)
        while name in edges:
            name, T_parent_child = edges[name]
            T = T_parent_child @ T
        return T

    T: Array = np.linalg.inv(from_top(base)) @ from_top(frame)
    return T


def assert_poses(edges: Edges, calibration: Calibration, atol: float = 1e-11) -> None:
    base = calibration[calibration.root].frame_id
    for sensor in calibration.sensors:
        np.testing.assert_allclose(
            pose_from(edges, base, sensor.frame_id), sensor.T_root_sensor, rtol=0, atol=atol
        )


def with_sensor(calibration: Calibration, name: str, **changes: Any) -> Calibration:
    sensors = tuple(dataclasses.replace(s, **changes) if s.name == name else s for s in calibration.sensors)
    return dataclasses.replace(calibration, sensors=sensors)


READERS = {"tf": read_tf, "urdf": read_urdf, "launch": read_launch}


@pytest.mark.parametrize("format", READERS)
def test_exported_poses_recompose(calibration: Calibration, format: str) -> None:
    assert_poses(READERS[format](export(calibration, format)), calibration)


@pytest.mark.parametrize("format", READERS)
def test_every_frame_has_the_root_as_its_parent(calibration: Calibration, format: str) -> None:
    """A driver may publish the children of camera_optical."""
    edges = READERS[format](export(calibration, format))
    assert {child: parent for child, (parent, _) in edges.items()} == dict.fromkeys(
        ["camera_optical", "laser_link", "camera_2_optical"], "velodyne"
    )


@pytest.mark.parametrize("format", READERS)
def test_edges_are_those_of_the_spanning_tree_where_asked_for(calibration: Calibration, format: str) -> None:
    text = export(calibration, format, parents="tree")
    edges = READERS[format](text)
    assert {child: parent for child, (parent, _) in edges.items()} == {
        "camera_optical": "velodyne", "laser_link": "velodyne", "camera_2_optical": "camera_optical",
    }  # fmt: skip
    assert_poses(edges, calibration)


def test_json_keeps_the_parents_of_the_spanning_tree(calibration: Calibration) -> None:
    sensors = json.loads(export(calibration, "json"))["sensors"]
    assert {name: one["parent"] for name, one in sensors.items()} == {
        s.name: s.parent for s in calibration.sensors
    }


@pytest.mark.parametrize("format", READERS)
@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9])
def test_poses_looking_straight_up_or_down_recompose(calibration: Calibration, format: str, pitch: float) -> None:
    R = Rotation.from_euler("xyz", [0.4, pitch, -1.1]).as_matrix()
    steep = with_sensor(calibration, "laser", T_root_sensor=se3.pose(R, np.array([0.1, 0.2, 0.3])))
    assert_poses(READERS[format](export(steep, format)), steep)


@pytest.mark.parametrize("format", READERS)
def test_frames_with_special_names_are_quoted(calibration: Calibration, format: str) -> None:
    odd = with_sensor(calibration, "laser", frame_id="laser<&\"'>: ümläut")
    assert_poses(READERS[format](export(odd, format)), odd)


@pytest.mark.parametrize("format", READERS)
def test_the_leading_slash_of_ros_1_is_dropped(calibration: Calibration, format: str) -> None:
    slashed = with_sensor(calibration, "laser", frame_id="/laser_link")
    assert "laser_link" in READERS[format](export(slashed, format))


@pytest.mark.parametrize("format", READERS)
def test_two_sensors_in_one_frame_are_refused(calibration: Calibration, format: str) -> None:
    same = with_sensor(calibration, "laser", frame_id="camera_optical")
    with pytest.raises(InputError, match="sensors camera, laser have the same frame_id 'camera_optical'"):
        export(same, format)


@pytest.mark.parametrize("format", READERS)
def test_a_sensor_without_a_frame_is_refused(calibration: Calibration, format: str) -> None:
    with pytest.raises(InputError, match=r"'laser' has no frame_id; give it one in rig.yaml"):
        export(with_sensor(calibration, "laser", frame_id=""), format)


def test_an_unknown_format_is_refused_with_those_there_are(calibration: Calibration) -> None:
    with pytest.raises(
        InputError, match="no export format 'sdf'; there are launch, tf, urdf, kalibr, camera_info"
    ):
        export(calibration, "sdf")


def test_the_root_alone_exports_to_an_empty_list(calibration: Calibration) -> None:
    alone = dataclasses.replace(calibration, sensors=calibration.sensors[:1], joint_covariance=np.zeros((6, 6)))
    assert {name: len(reader(export(alone, name))) for name, reader in READERS.items()} == dict.fromkeys(
        READERS, 0
    )


def test_launch_nodes_have_names_that_ros_allows(calibration: Calibration) -> None:
    text = export(with_sensor(calibration, "laser", frame_id="laser.link-2"), "launch")
    assert re.search(r"name='static_transform_\d_laser_link_2'", text)


def test_a_root_with_quotes_does_not_break_the_launch_file(calibration: Calibration) -> None:
    name = 'x"""\nimport os'
    sensors = tuple(
        dataclasses.replace(s, name=name) if s.parent is None
        else dataclasses.replace(s, parent=name if s.parent == "lidar" else s.parent)
        for s in calibration.sensors
    )  # fmt: skip
    odd = dataclasses.replace(calibration, root=name, sensors=sensors)
    assert len(read_launch(export(odd, "launch"))) == 3


# URDF written back

HEAD = """<?xml version='1.0' encoding="latin-1"?>
<!-- our robot: hands off -->
<robot name="bot" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <link name="base"><visual><origin xyz="9 9 9"/></visual></link>
"""
LINKS = "".join(
    f'  <link name="{n}"/>\n'
    for n in ("velodyne", "camera_optical", "camera_2_optical", "laser_link", "mast", "head")
)


def joint(parent: str, child: str, origin: str = "", kind: str = "fixed") -> str:
    return (
        f'  <joint name="{parent}_{child}" type="{kind}"><!-- > tricky -->\n    {origin}\n'
        f'    <parent link="{parent}"/><child link="{child}"/>\n  </joint>\n'
    )


def robot(*joints: str) -> str:
    return HEAD + LINKS + "".join(joints) + "</robot>\n<!-- end: ü -->\n"


OLD = '<origin xyz="1 2 3" rpy="0.1 0.2 0.3"/>'
SIMPLE = robot(
    joint("base", "mast", '<origin rpy="0 0 1.5" xyz="0 0 1"></origin>'),
    joint("mast", "velodyne", '<origin xyz="0.1 0 0.2" rpy="0.2 0.1 -0.3"/>'),
    joint("mast", "camera_optical", OLD),
    joint("camera_optical", "camera_2_optical", '<origin\n xyz="1 1 1"\n></origin>'),
    joint("base", "laser_link"),
)


def test_a_given_urdf_gets_the_calibrated_poses(calibration: Calibration) -> None:
    assert_poses(read_urdf(export(calibration, "urdf", urdf=SIMPLE)), calibration)


def test_the_root_stays_where_it_was_on_the_robot(calibration: Calibration) -> None:
    after = read_urdf(export(calibration, "urdf", urdf=SIMPLE))
    np.testing.assert_allclose(
        pose_from(after, "base", "velodyne"), pose_from(read_urdf(SIMPLE), "base", "velodyne"), atol=1e-12
    )


def test_the_rest_of_the_file_stays_as_it_is(calibration: Calibration) -> None:
    after = export(calibration, "urdf", urdf=SIMPLE)

    def without_origins(text: str) -> str:
        for edge in ("<origin", "</origin>"):
            text = "".join(part[part.find(">") + 1 :] if i and edge == "<origin" else part
                           for i, part in enumerate(text.split(edge)))  # fmt: skip
        return "".join(text.split())

    assert without_origins(after) == without_origins(SIMPLE)
    assert '<visual><origin xyz="9 9 9"/></visual>' in after


def test_writing_back_twice_changes_nothing(calibration: Calibration) -> None:
    once = export(calibration, "urdf", urdf=SIMPLE)
    twice = read_urdf(export(calibration, "urdf", urdf=once))
    for child, (parent, T) in read_urdf(once).items():
        assert twice[child][0] == parent
        np.testing.assert_allclose(twice[child][1], T, atol=1e-11)


@pytest.mark.parametrize(
    "joints",
    [
        # a sensor below a bracket below another sensor
        (joint("base", "velodyne", OLD), joint("velodyne", "camera_optical", OLD),
         joint("camera_optical", "mast", OLD), joint("mast", "camera_2_optical", OLD),
         joint("base", "laser_link", OLD)),
        # the root hangs from another sensor, over a bracket
        (joint("base", "camera_optical", OLD), joint("camera_optical", "mast", OLD),
         joint("mast", "velodyne", OLD), joint("camera_optical", "camera_2_optical"),
         joint("base", "laser_link", OLD)),
        # the root is the top
        (joint("velodyne", "camera_optical"), joint("velodyne", "laser_link"),
         joint("velodyne", "camera_2_optical")),
        # another sensor is the top
        (joint("laser_link", "base", OLD), joint("base", "velodyne", OLD), joint("base", "camera_optical", OLD),
         joint("camera_optical", "camera_2_optical")),
        # a movable joint that lies above all sensors does no harm
        (joint("base", "head", OLD, "revolute"), joint("head", "velodyne", OLD), joint("head", "camera_optical"),
         joint("head", "laser_link", OLD), joint("laser_link", "camera_2_optical", OLD)),
    ],
)  # fmt: skip
def test_any_order_of_joints_gives_the_calibrated_poses(calibration: Calibration, joints: tuple[str, ...]) -> None:
    assert_poses(read_urdf(export(calibration, "urdf", urdf=robot(*joints))), calibration)


def test_a_sensor_without_a_link_is_logged_and_left_out(
    calibration: Calibration, caplog: pytest.LogCaptureFixture
) -> None:
    urdf = robot(joint("base", "velodyne"), joint("base", "camera_optical"), joint("base", "laser_link"))
    after = read_urdf(export(calibration, "urdf", urdf=urdf))
    np.testing.assert_allclose(
        pose_from(after, "velodyne", "laser_link"), calibration["laser"].T_root_sensor, atol=1e-11
    )
    assert "sensor camera_2 is not in the URDF: no joint has the child link 'camera_2_optical'" in caplog.text


@pytest.mark.parametrize(
    ("urdf", "message"),
    [
        (robot(joint("base", "camera_optical")), "has no link 'velodyne', the frame of the root sensor"),
        (robot(joint("base", "velodyne")), "no joint whose child link is one of camera_optical, camera_2_opti"),
        (robot(joint("base", "velodyne"), joint("base", "head", "", "revolute"), joint("head", "laser_link")),
         "joint 'base_head' of the URDF is revolute, but lies between calibrated sensors"),
        (robot(joint("base", "velodyne"), joint("base", "laser_link", "", "prismatic")),
         "joint 'base_laser_link' of the URDF is prismatic"),
        (robot(joint("base", "velodyne"), joint("mast", "velodyne"), joint("base", "laser_link")),
         "link 'velodyne' of the URDF is the child of 2 joints"),
        (robot(joint("base", "velodyne"), joint("mast", "laser_link")),
         "links 'mast' and 'velodyne' of the URDF are not connected"),
        (robot(joint("velodyne", "mast"), joint("mast", "velodyne"), joint("mast", "laser_link")),
         "form a cycle through 'velodyne'"),
        (robot(joint("base", "velodyne", '<origin xyz="1 2"/>')),
         "joint 'base_velodyne' of the URDF: xyz must be three numbers of 1e.08 or less, got '1 2'"),
        (robot(joint("base", "velodyne", '<origin xyz="0 0 ${h}"/>')), "is a xacro; expand it first"),
        ("<robot><joint></robot>", "not valid XML: mismatched tag"),
        ("<sdf/>", "has no joints below its element <robot>"),
        ("", "not valid XML: no element found"),
    ],
)  # fmt: skip
def test_a_urdf_that_cannot_be_corrected_is_refused(calibration: Calibration, urdf: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        export(calibration, "urdf", urdf=urdf)


# Chosen joints


OPTICAL = '<origin xyz="0 0 0" rpy="-1.5707963267948966 0 -1.5707963267948966"/>'
REALSENSE = robot(
    joint("base", "velodyne", OLD),
    joint("base", "camera_bottom_screw_frame", '<origin xyz="0.3 0 0.4" rpy="0 0.1 0"/>'),
    joint("camera_bottom_screw_frame", "camera_link", '<origin xyz="0.0106 0.0175 0.0125" rpy="0 0 0"/>'),
    joint("camera_link", "camera_depth_frame", '<origin xyz="0 -0.01 0.002" rpy="0.01 0 0"/>'),
    joint("camera_depth_frame", "camera_optical", OPTICAL),
    joint("camera_link", "camera_color_frame", '<origin xyz="0 0.015 0"/>'),
    joint("camera_color_frame", "camera_2_optical", OPTICAL),
    joint("base", "laser_link"),
)
"""As the xacro of a RealSense: the driver publishes what is below camera_link."""


def changed_joints(before: str, after: str) -> set[str]:
    """Child links of the joints whose origin differs."""
    old, new = read_urdf(before), read_urdf(after)
    return {child for child in old if not np.allclose(old[child][1], new[child][1], atol=1e-12)}


def without(calibration: Calibration, *names: str) -> Calibration:
    """The calibration without some sensors."""
    kept = [k for k, sensor in enumerate(calibration.sensors) if sensor.name not in names]
    rows = np.concatenate([6 * k + np.arange(6) for k in kept])
    return dataclasses.replace(
        calibration,
        sensors=tuple(calibration.sensors[k] for k in kept),
        joint_covariance=calibration.joint_covariance[np.ix_(rows, rows)],
    )


@pytest.mark.parametrize("link", ["camera_depth_frame", "camera_link", "camera_bottom_screw_frame"])
def test_a_chosen_joint_gives_the_frame_below_it_the_calibrated_pose(calibration: Calibration, link: str) -> None:
    one = without(calibration, "camera_2", "laser")
    name = f"{read_urdf(REALSENSE)[link][0]}_{link}"
    after = export(one, "urdf", urdf=REALSENSE, joints={"camera": name})
    np.testing.assert_allclose(
        pose_from(read_urdf(after), "velodyne", "camera_optical"), one["camera"].T_root_sensor, atol=1e-9
    )
    assert changed_joints(REALSENSE, after) == {link}


def test_several_cameras_have_chosen_joints(calibration: Calibration) -> None:
    """camera has the joint of the case that both share, camera_2 the one of its lens in it."""
    joints = {"camera": "camera_bottom_screw_frame_camera_link", "camera_2": "camera_link_camera_color_frame"}
    after = export(calibration, "urdf", urdf=REALSENSE, joints=joints)
    for sensor in calibration.sensors:
        np.testing.assert_allclose(
            pose_from(read_urdf(after), "velodyne", sensor.frame_id), sensor.T_root_sensor, atol=1e-9
        )
    assert changed_joints(REALSENSE, after) == {"camera_link", "camera_color_frame", "laser_link"}


def test_a_chosen_joint_may_carry_the_root(calibration: Calibration) -> None:
    """The root's link is below another sensor's, so that the root's joint is the one that changes."""
    urdf = robot(joint("camera_optical", "mast", OLD), joint("mast", "head", OLD), joint("head", "velodyne", OLD))
    one = without(calibration, "camera_2", "laser")
    after = export(one, "urdf", urdf=urdf, joints={"lidar": "camera_optical_mast"})
    np.testing.assert_allclose(
        pose_from(read_urdf(after), "velodyne", "camera_optical"), one["camera"].T_root_sensor, atol=1e-9
    )
    assert changed_joints(urdf, after) == {"mast"}


CASE = "camera_bottom_screw_frame_camera_link"


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        ({"camera": "camera_bottom_screw_frame_camera_lnk"},
         "the URDF has no joint 'camera_bottom_screw_frame_camera_lnk'; did you mean "
         "'camera_bottom_screw_frame_camera_link'"),
        ({"laser": "xyz"}, "the URDF has no joint 'xyz'; those of laser are base_laser_link$"),
        ({"camera": "base_laser_link"},
         "joint 'base_laser_link' of the URDF does not place 'camera_optical', the frame of camera; "
         "those of camera are camera_depth_frame_camera_optical, camera_link_camera_depth_frame, "
         "camera_bottom_screw_frame_camera_link, base_camera_bottom_screw_frame$"),
        ({"camera": "base_velodyne"}, "joint 'base_velodyne' of the URDF does not place 'camera_optical'"),
        ({"lidar": "base_velodyne"}, "'velodyne', the frame of lidar; none moves it relative to the"),
        ({"camera": CASE, "camera_2": CASE}, "that of camera and of camera_2: its origin places one of them only"),
        ({"camera": CASE, "camera_2": "base_camera_bottom_screw_frame"},
         "joint 'base_camera_bottom_screw_frame' of the URDF is above joint "
         "'camera_bottom_screw_frame_camera_link', which places camera: choose one below it for camera_2"),
        ({"radar": CASE}, "there is no sensor 'radar' in this calibration; it has lidar, camera"),
    ],
)  # fmt: skip
def test_a_joint_that_cannot_be_chosen_is_refused(
    calibration: Calibration, joints: dict[str, str], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        export(calibration, "urdf", urdf=REALSENSE, joints=joints)


def test_a_chosen_joint_must_be_fixed(calibration: Calibration) -> None:
    urdf = robot(
        joint("base", "velodyne"), joint("base", "head", OLD, "revolute"), joint("head", "camera_optical")
    )
    with pytest.raises(InputError, match="joint 'base_head' of the URDF is revolute, but lies between calibrated"):
        export(without(calibration, "camera_2", "laser"), "urdf", urdf=urdf, joints={"camera": "base_head"})


def test_a_joint_for_a_frame_that_the_urdf_lacks_is_refused(calibration: Calibration) -> None:
    urdf = robot(joint("base", "velodyne"), joint("base", "camera_link"), joint("base", "laser_link"))
    with pytest.raises(
        InputError,
        match="does not place 'camera_optical', the frame of camera; none moves it relative to the other sensors",
    ):
        export(calibration, "urdf", urdf=urdf, joints={"camera": "base_camera_link"})


def test_the_rotation_to_an_image_is_changed_with_a_warning(
    calibration: Calibration, caplog: pytest.LogCaptureFixture
) -> None:
    one = without(calibration, "camera_2", "laser")
    after = export(one, "urdf", urdf=REALSENSE)
    assert changed_joints(REALSENSE, after) == {"camera_optical"}
    assert caplog.messages == [
        "sensor camera: its joint 'camera_depth_frame_camera_optical' was the rotation to the axes of the image, "
        "which drivers publish; a joint above it can be chosen instead: camera=base_camera_bottom_screw_frame"
    ]


def test_a_chosen_joint_has_no_warning(calibration: Calibration, caplog: pytest.LogCaptureFixture) -> None:
    export(without(calibration, "camera_2", "laser"), "urdf", urdf=REALSENSE, joints={"camera": CASE})
    assert caplog.messages == []


# Good poses only


def with_grades(calibration: Calibration, **grades: Grade) -> Calibration:
    for name, grade in grades.items():
        calibration = with_sensor(calibration, name, verdict=Verdict(grade, "loose"))
    return calibration


@pytest.mark.parametrize("format", ["tf", "launch", "urdf"])
def test_only_good_poses_are_exported(calibration: Calibration, format: str) -> None:
    edges = READERS[format](export(calibration, format, only="good"))
    assert set(edges) == {"camera_optical", "camera_2_optical"}


def test_what_a_weak_sensor_carries_has_the_nearest_good_one_as_its_parent(calibration: Calibration) -> None:
    """In the tree, camera_2 is below camera, and laser below camera_2 here."""
    below = with_sensor(calibration, "laser", parent="camera_2", verdict=Verdict("good"))
    edges = read_tf(export(with_grades(below, camera_2="weak"), "tf", parents="tree", only="good"))
    assert {child: parent for child, (parent, _) in edges.items()} == {
        "camera_optical": "velodyne", "laser_link": "camera_optical",
    }  # fmt: skip
    np.testing.assert_allclose(edges["laser_link"][1], calibration.transform("camera", "laser"), atol=1e-11)


def test_it_is_the_root_where_no_other_is_good(calibration: Calibration) -> None:
    edges = read_tf(export(with_grades(calibration, camera="weak"), "tf", parents="tree", only="good"))
    assert [(child, parent) for child, (parent, _) in edges.items()] == [("camera_2_optical", "velodyne")]
    np.testing.assert_allclose(edges["camera_2_optical"][1], calibration["camera_2"].T_root_sensor, atol=1e-11)


def test_covariances_of_good_poses_are_those_of_the_calibration(
    calibration: Calibration, rng: np.random.Generator
) -> None:
    """With correlations, of camera_2 and laser, after camera between them is left out."""
    root = rng.normal(0, 1e-3, (24, 24))
    joint_covariance = root @ root.T
    joint_covariance[:6], joint_covariance[:, :6] = 0.0, 0.0
    whole = dataclasses.replace(
        with_grades(calibration, camera="unobservable", laser="good"), joint_covariance=joint_covariance
    )
    good = keep_good_poses(whole)
    for a, b in (("lidar", "laser"), ("camera_2", "laser")):
        np.testing.assert_allclose(good.covariance(a, b), whole.covariance(a, b), rtol=1e-12)


def test_errors_of_priors_stay_those_of_their_sensor(calibration: Calibration) -> None:
    errors = PriorErrors((("board", "print scale"),), np.arange(24.0)[:, None])
    good = keep_good_poses(dataclasses.replace(with_grades(calibration, camera="weak"), prior_errors=errors))
    assert good.prior_errors is not None
    np.testing.assert_array_equal(good.prior_errors.poses[6:, 0], np.arange(12, 18))


def test_the_root_is_kept_as_the_frame_whatever_its_verdict(calibration: Calibration) -> None:
    edges = read_tf(export(with_grades(calibration, lidar="weak"), "tf", only="good"))
    assert {parent for parent, _ in edges.values()} == {"velodyne"}


def test_json_has_the_good_sensors_only(calibration: Calibration) -> None:
    content = json.loads(export(calibration, "json", only="good"))
    assert list(content["sensors"]) == ["lidar", "camera", "camera_2"]


def test_cameras_that_are_not_good_are_left_out_of_their_files(calibration: Calibration) -> None:
    weak, cameras = with_grades(calibration, camera="weak"), {"camera": PINHOLE, "camera_2": PINHOLE}
    content = YAML(typ="safe").load(export(weak, "camera_info", cameras=cameras, only="good"))
    assert content["camera_name"] == "camera_2"
    assert set(YAML(typ="safe").load(export(weak, "kalibr", cameras=cameras, only="good"))) == {"cam0"}


def test_joints_of_weak_sensors_stay_as_they_are(calibration: Calibration) -> None:
    """Good sensors have their poses, also camera_2 on the old pose of camera, whose chosen joint is ignored."""
    weak = with_grades(calibration, camera="weak")
    after = export(weak, "urdf", urdf=SIMPLE, only="good", joints={"camera": "mast_camera_optical", "sonar": "x"})
    assert changed_joints(SIMPLE, after) == {"camera_2_optical"}
    np.testing.assert_allclose(
        pose_from(read_urdf(after), "velodyne", "camera_2_optical"),
        calibration["camera_2"].T_root_sensor,
        atol=1e-9,
    )


def test_nothing_good_is_an_error(calibration: Calibration) -> None:
    with pytest.raises(CalibrationError, match="there is nothing to export: no pose is good"):
        export(with_grades(calibration, camera="weak", camera_2="unobservable"), "tf", only="good")


# Kalibr

K = np.array([[500.0, 0, 320], [0, 501, 240], [0, 0, 1]])
PINHOLE = CameraModel("pinhole", 640, 480, K, np.array([0.1, -0.2, 0.001, 0.002]))
FISHEYE = CameraModel("fisheye", 640, 480, K, np.array([0.1, -0.2, 0.01, 0.002]))


def camchain(calibration: Calibration, **arguments: Any) -> dict[str, Any]:
    content: dict[str, Any] = YAML(typ="safe").load(export(calibration, "kalibr", **arguments))
    return content


def test_a_camchain_chains_the_cameras(calibration: Calibration) -> None:
    chain = camchain(calibration, cameras={"camera": PINHOLE, "camera_2": FISHEYE})
    T_c1_c0 = np.array(chain["cam1"]["T_cn_cnm1"])
    expected = np.linalg.inv(calibration["camera_2"].T_root_sensor) @ calibration["camera"].T_root_sensor
    np.testing.assert_allclose(T_c1_c0, expected, atol=1e-12)
    assert list(chain) == ["cam0", "cam1"]
    assert "T_cn_cnm1" not in chain["cam0"]


def test_a_camchain_has_the_intrinsics(calibration: Calibration) -> None:
    chain = camchain(calibration, cameras={"camera": PINHOLE, "camera_2": FISHEYE})
    assert chain["cam0"] == {
        "cam_overlaps": [1], "camera_model": "pinhole", "distortion_model": "radtan",
        "distortion_coeffs": [0.1, -0.2, 0.001, 0.002], "intrinsics": [500.0, 501.0, 320.0, 240.0],
        "resolution": [640, 480],
    }  # fmt: skip
    assert chain["cam1"]["distortion_model"] == "equidistant"


def test_a_camchain_takes_topics_and_intrinsics_from_the_rig(calibration: Calibration) -> None:
    intrinsics = {"width": 640, "height": 480, "K": [500.0, 500.0, 320.0, 240.0], "distortion": [0.1, 0, 0, 0, 0]}
    rig = Rig.model_validate(
        {
            "root": "lidar",
            "target": {"kind": "people"},
            "sensors": {
                "lidar": {"kind": "lidar3d", "topic": "/points"},
                "camera": {"kind": "camera", "topic": "/left", "intrinsics": intrinsics},
                "camera_2": {"kind": "camera", "topic": "/right", "camera_info": "/info"},
            },
        }
    )
    plain = CameraModel("pinhole", 640, 480, K, np.empty(0))
    chain = camchain(calibration, rig=rig, cameras={"camera_2": plain})
    assert [c["rostopic"] for c in chain.values()] == ["/left", "/right"]
    assert [c["distortion_model"] for c in chain.values()] == ["radtan", "none"]
    assert [len(c["distortion_coeffs"]) for c in chain.values()] == [4, 0]


def test_a_camchain_without_intrinsics_is_refused(calibration: Calibration) -> None:
    with pytest.raises(InputError, match=r"intrinsics of 'camera_2' are not known; state them in rig.yaml"):
        camchain(calibration, cameras={"camera": PINHOLE})


def test_a_camchain_has_the_nearest_radtan_of_a_lens_with_a_third_coefficient(calibration: Calibration) -> None:
    with_k3 = CameraModel("pinhole", 640, 480, K, np.array([-0.2, 0.05, 0.001, -0.002, 0.02]))
    chain = camchain(calibration, cameras={"camera": with_k3, "camera_2": PINHOLE})
    assert chain["cam0"]["distortion_model"] == "radtan"
    radtan = dataclasses.replace(with_k3, distortion=np.array(chain["cam0"]["distortion_coeffs"]))
    x, y = np.meshgrid(np.linspace(0, 639, 33), np.linspace(0, 479, 25))
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
    without_k3 = dataclasses.replace(with_k3, distortion=with_k3.distortion[:4])
    off, before = (np.abs(lens.project(with_k3.rays(pixels)) - pixels).max() for lens in (radtan, without_k3))
    assert off < 0.5 < before


def test_a_camchain_refuses_a_lens_that_kalibr_lacks(calibration: Calibration) -> None:
    rational = CameraModel("pinhole", 640, 480, K, np.array([0, 0, 0, 0, 0, 2.0, 0, 0]))
    with pytest.raises(InputError, match=r"no distortion model for 'camera': .* this camera has 8 coefficients"):
        camchain(calibration, cameras={"camera": rational, "camera_2": PINHOLE})


def test_a_camchain_needs_a_camera(calibration: Calibration) -> None:
    without = dataclasses.replace(
        calibration,
        sensors=(calibration.sensors[0], calibration.sensors[3]),
        joint_covariance=calibration.joint_covariance[:12, :12],
    )
    with pytest.raises(InputError, match="needs a camera, this calibration has none"):
        camchain(without)


# JSON


def test_json_has_the_whole_result(calibration: Calibration) -> None:
    content = json.loads(export(calibration, "json"))
    assert content["root"] == "lidar"
    np.testing.assert_allclose(content["sensors"]["laser"]["T_root_sensor"], calibration["laser"].T_root_sensor)
    np.testing.assert_allclose(content["sensors"]["laser"]["covariance"], calibration["laser"].covariance)
    np.testing.assert_allclose(
        content["residuals"]["plane-line"], calibration.evidence.residuals["plane-line"], rtol=1e-5
    )
    assert len(content["captures"]) == 4
    assert content["unconnected"] == dict(calibration.evidence.unconnected)
    assert content["sensors"]["laser"]["verdict"]["grade"] == "weak"


def test_json_has_the_floor_views(calibration: Calibration, rng: np.random.Generator) -> None:
    view = FloorView("laser", rng.normal(size=(5, 2)), (rng.normal(size=(3, 2)), rng.normal(size=(2, 2))))
    (seen,) = json.loads(
        export(
            dataclasses.replace(
                calibration, pictures=dataclasses.replace(calibration.pictures, floor_views=(view,))
            ),
            "json",
        )
    )["floor"]
    assert seen["sensor"] == "laser"
    np.testing.assert_allclose(seen["background"], view.background)
    np.testing.assert_allclose(seen["walks"][1], view.tracks[1])


def test_json_has_null_for_what_is_not_finite(calibration: Calibration) -> None:
    joint = np.array(calibration.joint_covariance)
    joint[18:, 18:] = np.diag([np.inf, 1, 1, 1, 1, np.nan])
    loose = dataclasses.replace(calibration, joint_covariance=joint)
    covariance = json.loads(export(loose, "json"))["sensors"]["laser"]["covariance"]
    assert (covariance[0][0], covariance[1][1], covariance[5][5]) == (None, 1.0, None)


def test_every_format_is_tested() -> None:
    assert set(FORMATS) == {*READERS, "kalibr", "camera_info", "corrections", "json"}


@pytest.mark.parametrize("angles", np.random.default_rng(1).uniform(-np.pi, np.pi, (5, 3)).tolist())
def test_rotations_of_every_kind_survive_the_urdf(calibration: Calibration, angles: list[float]) -> None:
    turned = with_sensor(calibration, "camera", T_root_sensor=se3.pose(so3.exp(np.array(angles)), np.zeros(3)))
    assert_poses(read_urdf(export(turned, "urdf")), turned)


def test_camera_info_has_a_document_for_each_camera(calibration: Calibration) -> None:
    wide = CameraModel("fisheye", 640, 480, np.array([[300.0, 0, 320], [0, 301, 240], [0, 0, 1]]), np.zeros(4))
    names = [sensor.name for sensor in calibration.sensors if sensor.kind == "camera"]
    contents = list(
        YAML(typ="safe").load_all(export(calibration, "camera_info", cameras=dict.fromkeys(names, wide)))
    )
    assert [content["camera_name"] for content in contents] == names
    content = contents[-1]
    assert content["distortion_model"] == "equidistant"
    assert content["camera_matrix"]["data"] == [300.0, 0.0, 320.0, 0.0, 301.0, 240.0, 0.0, 0.0, 1.0]
    assert content["distortion_coefficients"]["data"] == [0.0] * 4
