"""A new URDF: a link for each sensor's frame, a fixed joint for each edge of the tree."""

import logging
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from itertools import takewhile

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array, se3, so3
from calgraph.geometry.so3 import from_roll_pitch_yaw, roll_pitch_yaw
from calgraph.result.calibration import Calibration
from calgraph.result.exports.frames import (
    TreeEdge,
    apply_stated_poses,
    describe_origin,
    format_coordinate,
    frame_ids,
    tree_edges,
)
from calgraph.result.exports.urdf_text import Joint, frames_from_joints, read_joints, replace_origins
from calgraph.result.frame_tree import FrameTree


def to_urdf(calibration: Calibration) -> str:
    """The text of a URDF whose links are the sensors' frames.

    Raises:
        InputError: a sensor has no frame_id, or two have the same.
    """
    lines = ['<?xml version="1.0"?>', f"<!-- {describe_origin(calibration)} -->", '<robot name="calgraph">']
    edges, frames = tree_edges(calibration), frame_ids(calibration).values()
    lines += [f"  <link name={_quote(frame)}/>" for frame in dict.fromkeys([*(e.parent for e in edges), *frames])]
    for link in edges:
        lines += _joint(link)
    return "\n".join([*lines, "</robot>", ""])


def origin_attributes(T_parent_child: Array) -> str:
    """``xyz="..." rpy="..."`` of an origin: metres, and angles about fixed axes, rad."""
    xyz = " ".join(map(format_coordinate, T_parent_child[:3, 3]))
    rpy = " ".join(map(format_coordinate, roll_pitch_yaw(T_parent_child[:3, :3])))
    return f'xyz="{xyz}" rpy="{rpy}"'


def _quote(text: str) -> str:
    from xml.sax.saxutils import quoteattr  # brings the modules of the web along, which no other command uses

    return quoteattr(text)


def _joint(link: TreeEdge) -> list[str]:
    return [
        f'  <joint name={_quote(f"{link.parent}_to_{link.child}")} type="fixed">',
        f"    <parent link={_quote(link.parent)}/>",
        f"    <child link={_quote(link.child)}/>",
        f"    <origin {origin_attributes(link.T_parent_child)}/>",
        "  </joint>",
    ]


_log = logging.getLogger(__name__)


def update_urdf(calibration: Calibration, urdf: str, joints_of_sensors: Mapping[str, str] | None = None) -> str:
    """The URDF with new origins, such that the relative poses of its sensor links are the calibrated ones.

    A sensor's link is the one named as its frame_id; sensors without one are logged and left out. A sensor's
    joint may have any link as parent: its new origin takes the fixed joints between that link and the other
    sensors into account. One sensor's joint is unchanged and attaches the rig to the robot: the root's, or that of
    the topmost sensor that carries the root. Everything else in the file, comments included, is unchanged too.

    Args:
        calibration: the poses.
        urdf: text of the URDF (an expanded one, not a xacro).
        joints_of_sensors: by sensor, the name of a joint above its link whose origin is changed instead: a driver
            of a camera may publish the frames from the camera's case to its image.

    Raises:
        InputError: the text is not a URDF, it lacks the root's link or those of all other sensors, a movable joint
            lies between two sensors, or a chosen joint does not move its sensor alone.
    """
    joints = read_joints(urdf)
    frame_tree = frames_from_joints(joints)
    poses = _poses_of_links(calibration, frame_tree)
    poses |= _pose_of_base(calibration, frame_tree)
    root = frame_ids(calibration)[calibration.root]
    anchor = [link for link in frame_tree.ancestry(root) if link in poses][-1]
    poses = _choose_joints(calibration, joints, frame_tree, poses, anchor, joints_of_sensors or {})
    origins = {}
    for link in poses.keys() & frame_tree.links.keys() - {anchor}:
        parent = frame_tree.links[link].parent
        T_parent_link = se3.inverse(_link_pose(frame_tree, poses, anchor, parent)) @ poses[link]
        frame_tree.check_fixed(link)
        origins[link] = origin_attributes(T_parent_link)
    return replace_origins(urdf, joints, origins)


def _poses_of_links(calibration: Calibration, frame_tree: FrameTree) -> dict[str, Array]:
    """``T_root_link`` (4, 4) of the sensors that have a link, by the link's name.

    Height, roll and pitch that a network does not measure, and rig.yaml does not state, are those of the URDF.
    """
    frame_of = frame_ids(calibration)
    missing = {name: frame for name, frame in frame_of.items() if frame not in frame_tree.frames}
    if calibration.root in missing:
        raise InputError(f"the URDF has no link {missing[calibration.root]!r}, the frame of the root sensor")
    if len(missing) == len(frame_of) - 1:
        raise InputError(f"the URDF has no joint whose child link is one of {', '.join(missing.values())}")
    for name, frame in missing.items():
        _log.warning("sensor %s is not in the URDF: no joint has the child link %r", name, frame)
    stated = any(sensor.stated for sensor in calibration.sensors)
    placed, root = apply_stated_poses(calibration), frame_of[calibration.root]
    poses = {frame: placed[name].T_root_sensor for name, frame in frame_of.items() if name not in missing}
    if not calibration.planar or stated:
        return poses
    return {frame: _keep_out_of_plane(T, frame_tree.transform(root, frame)) for frame, T in poses.items()}


def _pose_of_base(calibration: Calibration, frame_tree: FrameTree) -> dict[str, Array]:
    """``T_root_base`` (4, 4) of the vehicle's link, if it carries the root; what is not measured is the URDF's."""
    base, root = calibration.base, frame_ids(calibration)[calibration.root]
    if base is None or not base.known or base.frame not in frame_tree.ancestry(root):
        return {}
    before = frame_tree.transform(base.frame, root)
    T = base.complete(before)
    return {base.frame: se3.inverse(_keep_out_of_plane(T, before) if "z" in base.missing else T)}


def _choose_joints(
    calibration: Calibration,
    joints: Sequence[Joint],
    frame_tree: FrameTree,
    poses: Mapping[str, Array],
    anchor: str,
    joints_of_sensors: Mapping[str, str],
) -> dict[str, Array]:
    """``T_root_link`` (4, 4) of the anchor, and of the links below the joints that change, one for each sensor.

    Args:
        calibration: the sensors.
        joints: of the URDF.
        frame_tree: its links.
        poses: ``T_root_link`` (4, 4) of the sensors' links.
        anchor: the link whose joint does not change.
        joints_of_sensors: the chosen joint by sensor; that above its link for all others.
    """
    by_name, above = {joint.name: joint for joint in joints}, {joint.child: joint for joint in joints}
    frame_of, fixed = frame_ids(calibration), set(frame_tree.ancestry(anchor))
    placed, sensor_of = {anchor: poses[anchor]}, dict[str, str]()
    between: dict[str, list[str]] = {}
    others = [name for name, frame in frame_of.items() if frame in poses and frame != anchor]
    for sensor in dict.fromkeys([*joints_of_sensors, *others]):
        calibration[sensor]  # raises where there is none
        frame, chosen = frame_of[sensor], joints_of_sensors.get(sensor)
        path = list(takewhile(lambda link: link not in fixed, frame_tree.ancestry(frame)))
        movers = [above[link].name for link in path if link in above]
        if chosen is not None:
            _check_choice(sensor, frame, chosen, movers, by_name)
        elif len(movers) > 1 and _is_optical(above[frame].T_parent_child):
            _log.warning(
                "sensor %s: its joint %r was the rotation to the axes of the image, which drivers publish; "
                "a joint above it can be chosen instead: %s=%s", sensor, movers[0], sensor, movers[-1],
            )  # fmt: skip
        link = frame if chosen is None else by_name[chosen].child
        if link in placed:
            raise InputError(
                f"joint {above[link].name!r} of the URDF is that of {sensor_of[link]} and of {sensor}: its origin "
                "places one of them only"
            )
        sensor_of[link], between[sensor] = sensor, path[: path.index(link)]
        placed[link] = poses[frame] @ se3.inverse(frame_tree.transform_to_ancestor(link, frame))
    for sensor, link in ((sensor, link) for sensor, links in between.items() for link in links if link in placed):
        raise InputError(
            f"joint {joints_of_sensors[sensor]!r} of the URDF is above joint {above[link].name!r}, which places "
            f"{sensor_of[link]}: choose one below it for {sensor}"
        )
    return placed


def _check_choice(
    sensor: str, frame: str, chosen: str, movers: Sequence[str], joints: Mapping[str, Joint]
) -> None:
    """Raises InputError if a joint is not one of those that move a sensor relative to the rest of the rig."""
    if chosen in movers:
        return
    those = (
        f"those of {sensor} are {', '.join(movers)}" if movers else "none moves it relative to the other sensors"
    )
    if chosen not in joints:
        close = " or ".join(map(repr, get_close_matches(chosen, joints)))
        raise InputError(f"the URDF has no joint {chosen!r}; {f'did you mean {close}?' if close else those}")
    raise InputError(f"joint {chosen!r} of the URDF does not place {frame!r}, the frame of {sensor}; {those}")


# The rotation from the axes of a camera's case to those of its image (REP 103), and how far a joint may be off it:
# numbers of URDFs are rounded.
_T_LINK_OPTICAL = se3.pose(from_roll_pitch_yaw(-np.pi / 2, 0.0, -np.pi / 2), np.zeros(3))
_OPTICAL_ROUNDING = 1e-3


def _is_optical(T_parent_child: Array) -> bool:
    """Whether a joint does no more than to rotate to the axes of an image."""
    return bool(np.abs(T_parent_child - _T_LINK_OPTICAL).max() < _OPTICAL_ROUNDING)


def _keep_out_of_plane(T_planar: Array, T_before: Array) -> Array:
    """A planar pose (4, 4) with height, roll and pitch of another one, if that is the same way up."""
    if T_planar[2, 2] * T_before[2, 2] < 0:
        return T_planar
    yaw = (np.arctan2(T[1, 0], T[0, 0]) for T in (T_planar, T_before))
    turn = so3.exp(np.array([0.0, 0.0, next(yaw) - next(yaw)]))
    return se3.pose(turn @ T_before[:3, :3], np.array([*T_planar[:2, 3], T_before[2, 3]]))


def _link_pose(frame_tree: FrameTree, poses: Mapping[str, Array], anchor: str, link: str) -> Array:
    """``T_root_link`` (4, 4) of any link: by the sensor that carries it, or by the anchor's place on the robot."""
    ancestry = frame_tree.ancestry(link)
    carrier = next((upper for upper in ancestry if upper in poses), None)
    if carrier is not None:
        return poses[carrier] @ frame_tree.transform_to_ancestor(carrier, link)
    shared = next((upper for upper in ancestry if upper in frame_tree.ancestry(anchor)), None)
    if shared is None:
        raise InputError(f"links {link!r} and {anchor!r} of the URDF are not connected by joints")
    return (
        poses[anchor]
        @ se3.inverse(frame_tree.transform_to_ancestor(shared, anchor))
        @ frame_tree.transform_to_ancestor(shared, link)
    )
