"""The calibrated tree as YAML in the layout of ROS' tf2_msgs/TFMessage."""

from typing import Any

from calgraph.io.yaml_writing import format_yaml
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
