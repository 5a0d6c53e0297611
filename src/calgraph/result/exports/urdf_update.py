"""A given URDF with the calibrated poses written into the joints of the sensors' links."""

import logging
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array, se3
from calgraph.result.calibration import Calibration
from calgraph.result.exports.frames import frames
from calgraph.result.exports.urdf import origin_attributes
from calgraph.result.exports.urdf_text import Joint, read_joints, replace_origins

_log = logging.getLogger(__name__)


def update_urdf(calibration: Calibration, urdf: str) -> str:
    """The URDF with new origins, such that its sensor links stand to each other as calibrated.

    A sensor's link is the one named as its frame_id; sensors without one are logged and left out. A sensor's
    joint may hang from any link: its new origin takes the fixed joints between that link and the other sensors
    into account. One sensor's joint stays as it is and holds the rig to the robot: the root's, or that of the
    topmost sensor that carries the root. Everything else in the file, comments included, stays as it is too.

    Args:
        calibration: the poses.
        urdf: text of the URDF (an expanded one, not a xacro).

    Raises:
        InputError: the text is not a URDF, it lacks the root's link or those of all other sensors, or a movable
            joint lies between two sensors.

    """
    joints = read_joints(urdf)
    robot = _Robot(_by_child(joints))
    poses = _poses_of_links(calibration, robot)
    root = frames(calibration)[calibration.root]
    anchor = [link for link in robot.upwards(root) if link in poses][-1]
    origins = {}
    for link in poses.keys() & robot.joint_above.keys() - {anchor}:
        parent = robot.joint_above[link].parent
        T_parent_link = se3.inverse(_pose(robot, poses, anchor, parent)) @ poses[link]
        robot.check_fixed(link)
        origins[link] = origin_attributes(T_parent_link)
    return replace_origins(urdf, joints, origins)


@dataclass(frozen=True)
class _Robot:
    """The tree of links that a URDF describes."""

    joint_above: Mapping[str, Joint]
    """The joint by which a link hangs, by the link's name."""

    @property
    def links(self) -> set[str]:
        """The names of all links that a joint names."""
        return set(self.joint_above) | {joint.parent for joint in self.joint_above.values()}

    def upwards(self, link: str) -> list[str]:
        """The link, its parent, and so on up to the top."""
        line = [link]
        while line[-1] in self.joint_above:
            line.append(self.joint_above[line[-1]].parent)
            if line[-1] in line[:-1]:
                raise InputError(f"the joints of the URDF form a circle through link {line[-1]!r}")
        return line

    def chain(self, upper: str, lower: str) -> Array:
        """``T_upper_lower`` (4, 4) along the joints between a link and one of its ancestors, all of them fixed."""
        T_upper_lower = np.eye(4)
        while lower != upper:
            self.check_fixed(lower)
            T_upper_lower = self.joint_above[lower].T_parent_child @ T_upper_lower
            lower = self.joint_above[lower].parent
        return T_upper_lower

    def check_fixed(self, link: str) -> None:
        """Refuses a movable joint above a link."""
        joint = self.joint_above[link]
        if joint.type != "fixed":
            raise InputError(
                f"joint {joint.name!r} of the URDF is {joint.type or 'of no type'}, but lies between calibrated "
                "sensors, which must be fixed to each other"
            )


def _by_child(joints: list[Joint]) -> dict[str, Joint]:
    child, count = Counter(joint.child for joint in joints).most_common(1)[0]
    if count > 1:
        raise InputError(f"link {child!r} of the URDF is the child of {count} joints, it can be of one only")
    return {joint.child: joint for joint in joints}


def _poses_of_links(calibration: Calibration, robot: _Robot) -> dict[str, Array]:
    """``T_root_link`` (4, 4) of the sensors that have a link, by the link's name."""
    frame_of = frames(calibration)
    missing = {name: frame for name, frame in frame_of.items() if frame not in robot.links}
    if calibration.root in missing:
        raise InputError(f"the URDF has no link {missing[calibration.root]!r}, the frame of the root sensor")
    if len(missing) == len(frame_of) - 1:
        raise InputError(f"the URDF has no joint whose child link is one of {', '.join(missing.values())}")
    for name, frame in missing.items():
        _log.warning("sensor %s is not in the URDF: no joint has the child link %r", name, frame)
    return {frame: calibration[name].T_root_sensor for name, frame in frame_of.items() if name not in missing}


def _pose(robot: _Robot, poses: Mapping[str, Array], anchor: str, link: str) -> Array:
    """``T_root_link`` (4, 4) of any link: by the sensor that carries it, or by the anchor's place on the robot."""
    line = robot.upwards(link)
    carrier = next((upper for upper in line if upper in poses), None)
    if carrier is not None:
        return poses[carrier] @ robot.chain(carrier, link)
    shared = next((upper for upper in line if upper in robot.upwards(anchor)), None)
    if shared is None:
        raise InputError(f"links {link!r} and {anchor!r} of the URDF are not connected by joints")
    return poses[anchor] @ se3.inverse(robot.chain(shared, anchor)) @ robot.chain(shared, link)
