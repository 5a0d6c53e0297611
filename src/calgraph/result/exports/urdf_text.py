"""The joints of a URDF, with where in its text their origins stand, so that a file can be corrected in place."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.parsers import expat

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array, se3
from calgraph.geometry.so3 import from_roll_pitch_yaw
from calgraph.result.frame_tree import MAX_DISTANCE, FrameLink, FrameTree

_TAG = re.compile(rb"""<(?:[^"'>]|"[^"]*"|'[^']*')*>""")


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint of a URDF."""

    name: str
    type: str
    parent: str
    """Name of the parent link."""
    child: str
    T_parent_child: Array
    """(4, 4); of a movable joint at its zero position."""
    span: tuple[int, int]
    """Bytes of the origin's start tag in the file; empty, after the joint's start tag, where it has no origin."""


@dataclass
class _PartialJoint:
    """A joint while its element is being read."""

    attributes: dict[str, str]
    insertion: int
    origin: dict[str, str] | None = None
    span: tuple[int, int] | None = None
    parent: str = ""
    child: str = ""


def read_joints(text: str) -> list[Joint]:
    """The joints of a URDF, in the order of the file.

    Raises:
        InputError: the text is not XML, not a URDF, or a joint's origin is not made of numbers.
    """
    content = text.encode()
    drafts: list[_PartialJoint] = []
    path: list[str] = []
    # The text has been decoded: the encoding that the file declares no longer applies.
    parser = expat.ParserCreate("utf-8")

    def start(tag: str, attributes: dict[str, str]) -> None:
        path.append(tag)
        if tag.startswith("xacro:") or any("${" in value for value in attributes.values()):
            raise InputError("the URDF is a xacro; expand it first: xacro robot.urdf.xacro > robot.urdf")
        position = parser.CurrentByteIndex
        if path == ["robot", "joint"]:
            drafts.append(_PartialJoint(attributes, _end_of_tag(content, position)))
        elif path[:2] == ["robot", "joint"] and len(path) == 3:
            _add(drafts[-1], tag, attributes, (position, _end_of_tag(content, position)))

    def end(_tag: str) -> None:
        path.pop()

    def refuse_entity(name: str, *_declaration: object) -> None:
        raise InputError(f"the URDF declares an entity, {name!r}, which no URDF needs: write it out")

    parser.StartElementHandler = start
    parser.EntityDeclHandler = refuse_entity
    parser.EndElementHandler = end
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise InputError(f"the URDF is not valid XML: {error}") from error
    if not drafts:
        raise InputError("the URDF has no joints below its element <robot>")
    return [_joint(draft) for draft in drafts]


def frames_from_joints(joints: Sequence[Joint], source: str = "the URDF") -> FrameTree:
    """The links of a URDF as a tree of frames.

    Raises:
        InputError: a link has two parents.
    """
    child, count = Counter(joint.child for joint in joints).most_common(1)[0]
    if count > 1:
        raise InputError(f"link {child!r} of the URDF is the child of {count} joints, it can be of one only")
    return FrameTree(source, {joint.child: _frame_link(joint) for joint in joints})


def _frame_link(joint: Joint) -> FrameLink:
    fixed = joint.type == "fixed"
    movable = "" if fixed else f"joint {joint.name!r} of the URDF is {joint.type or 'of no type'}"
    return FrameLink(joint.parent, joint.T_parent_child, movable)


def replace_origins(text: str, joints: Sequence[Joint], origins: Mapping[str, str]) -> str:
    """The text with new origins for the joints above some links, everything else as it was.

    Args:
        text: the URDF.
        joints: its joints, as :func:`read_joints` gives them.
        origins: the attributes of the new origin, by name of the joint's child link.
    """
    content = text.encode()
    # From the back, so that the positions of what is still to be replaced stay right.
    for joint in sorted(joints, key=lambda joint: joint.span, reverse=True):
        if joint.child in origins:
            first, last = joint.span
            new = f"<origin {origins[joint.child]}".encode()
            content = content[:first] + _replace_tag(new, content[first:last]) + content[last:]
    return content.decode()


def _replace_tag(new: bytes, old: bytes) -> bytes:
    """The tag ``new`` closed as ``old`` was, or on a new line where there was none."""
    if not old:
        return b"\n    " + new + b"/>"
    return new + (b"/>" if old.endswith(b"/>") else b">")


def _add(draft: _PartialJoint, tag: str, attributes: dict[str, str], span: tuple[int, int]) -> None:
    if tag == "origin":
        draft.origin, draft.span = attributes, span
    elif tag == "parent":
        draft.parent = attributes.get("link", "")
    elif tag == "child":
        draft.child = attributes.get("link", "")


def _joint(draft: _PartialJoint) -> Joint:
    name = draft.attributes.get("name", "")
    if not draft.parent or not draft.child:
        raise InputError(f"joint {name!r} of the URDF needs a parent and a child link")
    origin = draft.origin or {}
    roll, pitch, yaw = _numbers(name, "rpy", origin.get("rpy", "0 0 0"))
    xyz = np.array(_numbers(name, "xyz", origin.get("xyz", "0 0 0")))
    T = se3.pose(from_roll_pitch_yaw(roll, pitch, yaw), xyz)
    span = draft.span or (draft.insertion, draft.insertion)
    return Joint(name, draft.attributes.get("type", ""), draft.parent, draft.child, T, span)


def _numbers(joint: str, attribute: str, text: str) -> list[float]:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != 3 or not all(abs(value) <= MAX_DISTANCE for value in values):
        raise InputError(
            f"joint {joint!r} of the URDF: {attribute} must be three numbers of {MAX_DISTANCE:g} or less, "
            f"got {text[:60]!r}"
        )
    return values


def _end_of_tag(content: bytes, start: int) -> int:
    """The position after the tag that begins at ``start``; a > inside quotes does not end it."""
    match = _TAG.match(content, start)
    # expat reports only tags that are complete.
    assert match is not None
    return match.end()
