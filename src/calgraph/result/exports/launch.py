"""A ROS 2 launch file, in Python, that publishes the calibrated tree as static transforms."""

import re

from calgraph.result.calibration import Calibration
from calgraph.result.exports.frames import TreeEdge, describe_origin, format_coordinate, tree_edges

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
