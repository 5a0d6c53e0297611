"""The calibrated tree as YAML in the layout of ROS' tf2_msgs/TFMessage."""

import re
from typing import Any

from calgraph.io.text_writing import format_yaml
from calgraph.result.calibration import Calibration
from calgraph.result.exports.frames import TreeEdge, describe_origin, format_coordinate, tree_edges

_COMMENT = """\
Static transforms in the layout of tf2_msgs/TFMessage: each maps coordinates in child_frame_id to header.frame_id.
translation in metres; rotation is a unit quaternion.
ros2 topic pub --qos-durability transient_local /tf_static tf2_msgs/msg/TFMessage "$(cat FILE)" publishes them."""


def to_tf_yaml(calibration: Calibration) -> str:
    """A mapping with the one key ``transforms``: a list of geometry_msgs/TransformStamped, parents first.

    Each has ``header: {stamp: {sec, nanosec}, frame_id}``, ``child_frame_id`` and ``transform: {translation:
    {x, y, z}, rotation: {x, y, z, w}}``, with the names and the nesting of the ROS messages; the stamp is zero.

    Raises:
        InputError: a sensor has no frame_id, or two have the same.
    """
    comment = f"{_COMMENT}\n{describe_origin(calibration)}"
    return format_yaml({"transforms": [_stamped(link) for link in tree_edges(calibration)]}, comment)


def _stamped(link: TreeEdge) -> dict[str, Any]:
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": link.parent},
        "child_frame_id": link.child,
        "transform": {
            "translation": {key: float(format_coordinate(v)) for key, v in zip("xyz", link.xyz, strict=True)},
            "rotation": {key: float(format_coordinate(v)) for key, v in zip("xyzw", link.xyzw, strict=True)},
        },
    }


_HEAD = '''\
"""Static transforms of the sensors (root: {root}): ros2 launch ./FILE publishes them.

{origin}
"""

from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    return LaunchDescription([
'''


def to_launch(calibration: Calibration) -> str:
    """The text of a launch file with one static_transform_publisher for each edge of the tree.

    Raises:
        InputError: a sensor has no frame_id, or two have the same.
    """
    nodes = "".join(_node(index, link) for index, link in enumerate(tree_edges(calibration)))
    # The root's name goes into a docstring; only what cannot end it is let through.
    root = re.sub(r"[^\w .:/-]", "_", calibration.root)
    return _HEAD.format(root=root, origin=describe_origin(calibration)) + nodes + "    ])\n"


def _node(index: int, link: TreeEdge) -> str:
    x, y, z = map(format_coordinate, link.xyz)
    qx, qy, qz, qw = map(format_coordinate, link.xyzw)
    name = f"static_transform_{index}_{re.sub(r'[^0-9A-Za-z_]', '_', link.child)}"
    return f"""\
        Node(
            package="tf2_ros",
            executable="static_transform_publisher",
            name={name!r},
            arguments=[
                "--x", "{x}", "--y", "{y}", "--z", "{z}",
                "--qx", "{qx}", "--qy", "{qy}", "--qz", "{qz}", "--qw", "{qw}",
                "--frame-id", {link.parent!r}, "--child-frame-id", {link.child!r},
            ],
        ),
"""
