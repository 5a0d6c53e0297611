"""A new URDF: a link for each sensor's frame, a fixed joint for each edge of the tree."""

from calgraph.geometry import Array
from calgraph.result.calibration import Calibration
from calgraph.result.exports.frames import (
    TreeEdge,
    describe_origin,
    format_coordinate,
    frame_ids,
    roll_pitch_yaw,
    tree_edges,
)


def to_urdf(calibration: Calibration) -> str:
    """The text of a URDF whose links are the sensors' frames.

    Raises:
        InputError: a sensor has no frame_id, or two have the same.
    """
    lines = ['<?xml version="1.0"?>', f"<!-- {describe_origin(calibration)} -->", '<robot name="calgraph">']
    lines += [f"  <link name={_quote(frame)}/>" for frame in frame_ids(calibration).values()]
    for link in tree_edges(calibration):
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
