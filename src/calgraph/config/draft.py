"""A first rig.yaml from the topics of a recording, with comments on what to check and what to measure."""

import json
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from calgraph.config.rig_config import DRIVE_KINDS, CaptureMode
from calgraph.errors import InputError
from calgraph.sensors.kinds import KINDS, TF_TYPES, KindName, motion_kind_of

Kind = KindName | Literal["camera_info", "event", "other"]

# Last parts of the image topics of one camera (image_transport, image_proc), preferred first: the intrinsics
# describe the unrectified images.
_IMAGE_TOPICS = ("image_raw", "image_color", "image_mono", "image", "image_rect_color", "image_rect")
_DEPTH = re.compile(r"depth|disparity|confidence", re.IGNORECASE)
# Ends of topics of image_transport.
_TRANSPORT = re.compile(r"/compressed(Depth)?$")
# Depth images that are converted to the view of another camera: they hold nothing that the original ones do not.
_REGISTERED = re.compile(r"aligned_depth|depth_to_rgb|depth_registered|registered_depth", re.IGNORECASE)
_TRIGGER = re.compile(r"trigger|capture|shutter|snapshot", re.IGNORECASE)
# YAML 1.1 readers take some of these words as booleans, null or numbers.
_PLAIN = re.compile(r"(?!(?:y|n|yes|no|on|off|true|false|null)$)[A-Za-z/][\w./-]*", re.IGNORECASE)

_NO_TARGET = """\
# CHANGE THIS: state the board that you printed, as you measured it; the size of its tags or squares sets the scale
# of the cameras. calgraph board prints a board and its target block, which calgraph init can copy.
# target:
#   kind: board
#   size: [WIDTH, HEIGHT]       # of the board, m
#   family: tag36h11            # of the AprilTags
#   tags:                       # size: edge of the black square; center: x right, y up from the board's centre; m
#     - {id: 0, size: EDGE, center: [X, Y]}
#   Or, instead of family and tags, one pattern:
#   pattern: {kind: checkerboard, columns: 7, rows: 5, square: EDGE}    # columns, rows: inner corners; square: m
#   pattern: {kind: charuco, columns: 8, rows: 6, square: EDGE, marker: EDGE, dictionary: DICT_5X5_100}
#   pattern: {kind: aprilgrid, columns: 6, rows: 6, tag_size: EDGE, tag_spacing: 0.3}
"""
_NO_TARGET_OF_SCANNERS = """\
# Or, for scanners that are fixed in a building, the people who walked through:
# target: {kind: people}
"""
_SURROUNDINGS = """\
# CHECK: this is taken for a robot that drives, as {reason}.
# A drive needs no target: sensors are calibrated by the walls, floors and furniture that they pass one after the
# other. If a board was shown to sensors at rest instead, state it here: calgraph board prints its block.
target:
  kind: surroundings
# To get the root on the vehicle, too:
# base: {{frame: base_link, axle: rear}}
"""
_PEOPLE = """\
# CHECK: this is taken for LiDARs that are fixed in a building, as {reason}.
# They are calibrated from people who walk through their views. If a board was shown to LiDARs of one robot
# instead, state it here: calgraph board prints its block.
target:
  kind: people
# Distances between LiDARs are as good as the scale of their ranges: measure known distances, and state for each
# what is left of the relative error, as uncertainty: {{range_scale: 0.0005}}; 0.003 is assumed.
"""
_LEVEL_SCANNERS = """\
# Walls and people do not show the height, roll and pitch of a 2-D scanner: measure them, and state for each
# height: 1.4 (m over the floor), roll: 0, pitch: 0 (degrees), uncertainty: {tilt: 0.5}.
"""
_OPTIONAL = """\
# These can take part, too: take their # away. Cameras need boards that are fixed in the room, as target.boards.\
"""
_NO_INTRINSICS = (
    "    # No usable camera_info was found: intrinsics are estimated from the same images. State them if they\n"
    "    # are known; K is fx, fy, cx, cy."
)
_NO_INTRINSICS_OF_CORNERS = (
    "    # CHANGE: state the intrinsics, as corners do not have the size of the images; K is fx, fy, cx, cy"
)
_NO_BACKGROUND = (
    "# background: [0.0, 5.0]      # s from the start: the room without board and operator; none was found"
)

_MODES = {
    "snapshots": "each time is one capture of the board",
    "synchronized": "each set of frames is one capture of the board",
}
"""What a mode other than rest means, for the comment."""


@dataclass(frozen=True)
class FoundTopic:
    """A topic of a recording, as far as a draft needs it."""

    name: str
    type: str
    """Message type, for display."""
    kind: Kind
    """What the topic can serve as; ``event`` for messages that could mark a capture."""
    count: int
    """Number of messages."""
    frame_id: str = ""
    """Of its first message."""
    problem: str = ""
    """Why its first message cannot be used, where it cannot."""
    own_clock: bool = False
    """Whether its stamps count from its own start, as those of a video do."""


@dataclass(frozen=True)
class FoundBackground:
    """The time without board and operator at the start of a recording, as far as a draft needs it."""

    end: float
    """s from the start."""
    entry: str
    """What was measured at its end."""
    searched: bool = True
    """Whether the board was searched for in the images of cameras, if there are any."""


@dataclass(frozen=True)
class _Sensor:
    name: str
    topic: FoundTopic
    info: FoundTopic | None


def draft_rig(
    topics: Sequence[FoundTopic],
    recording: str,
    target: str = "",
    background: FoundBackground | None = None,
    mode: tuple[CaptureMode, str] | None = None,
    drive: str = "",
    network: str = "",
) -> str:
    """The text of a rig.yaml with every sensor found, one for each camera however many topics it has.

    Args:
        topics: all topics of the recording.
        recording: its name, for the comments.
        target: the block of the target; without one, the draft has a comment in its place, and does not load.
        background: the time without board and operator, if one was found.
        mode: how the recording shows the board, and why, if that is known; its triggers come first.
        drive: why it is of a robot that drives, which needs no target; empty where it is not.
        network: why it is of LiDARs that are fixed in a building; empty where it is not.

    Raises:
        InputError: there is no sensor among the topics.
    """
    sensors, unused = _assign_topics([_claim_motion(topic) for topic in topics] if drive else topics)
    if drive:
        return _draft_drive(topics, recording, drive, sensors, unused)
    if not sensors:
        found = "; ".join(_list_unused(topics, unused)) or "none"
        raise InputError(
            f"{recording}: has no topic with usable images, laser scans or point clouds; its topics are: {found}"
        )
    if network:
        people = _PEOPLE.format(reason=_single_line(network))
        # The root measures the floor.
        roots = [one for one in sensors if one.topic.kind == "lidar3d"]
        people += _LEVEL_SCANNERS * (len(roots) < len(sensors))
        parts = [_head(recording, board=False), _root(roots), people, _sensors(sensors)]
        return "\n".join([*parts, *filter(None, [_unused_topics(topics, unused)])])
    parts = [
        _head(
            recording,
            [name for s in sensors for name in (s.topic.name, s.info.name if s.info else "") if name],
            ros=any("/" in sensor.topic.type for sensor in sensors),
        ),
        _root(sensors),
        target or _missing_target(sensors),
        _capture(topics, background, mode),
        _sensors(sensors),
        _unused_topics(topics, unused),
    ]
    return "\n".join(part for part in parts if part)


def _claim_motion(topic: FoundTopic) -> FoundTopic:
    """The topic as that of a kind that is calibrated in a drive only, if it is one; tf has several frames."""
    kind = motion_kind_of(topic.type)
    if topic.type in TF_TYPES:
        return replace(topic, problem="kind: trajectory with frame_id and parent takes the poses of one frame")
    return replace(topic, kind=kind, problem="") if kind else topic


def _draft_drive(
    topics: Sequence[FoundTopic],
    recording: str,
    reason: str,
    sensors: Sequence[_Sensor],
    unused: Mapping[str, str],
) -> str:
    """The text of a rig.yaml of a robot that drives.

    What may be redundant, as an odometry beside two scanners, or needs boards in the room, is a comment.
    """
    scanners = [one for one in sensors if one.topic.kind in ("lidar2d", "lidar3d")]
    motions = [one for one in sensors if KINDS[one.topic.kind].detects == "motion"]
    cameras = [one for one in sensors if one.topic.kind == "camera"]
    used = scanners if len(scanners) > 1 else [*scanners, *motions]
    optional = [f"# {line}" for one in [*motions, *cameras] if one not in used for line in _sensor(one, False)]
    left_out = {
        one.topic.name: "is of a kind that a drive does not calibrate"
        for one in sensors
        if one.topic.kind not in DRIVE_KINDS
    }
    parts = [
        _head(recording, board=False),
        _root(used),
        _SURROUNDINGS.format(reason=_single_line(reason)),
        _sensors(used),
        "\n".join([_OPTIONAL, *optional, ""]) if optional else "",
        _unused_topics(topics, {**unused, **left_out}),
    ]
    return "\n".join(part for part in parts if part)


def explain_unused(topics: Sequence[FoundTopic]) -> dict[str, str]:
    """Why each topic that a draft does not use is not used, by name."""
    return _assign_topics(topics)[1]


def _assign_topics(topics: Sequence[FoundTopic]) -> tuple[list[_Sensor], dict[str, str]]:
    """The sensors to draft, and why each topic is not used that is neither theirs nor a trigger."""
    chosen, unused = _choose_topics(topics)
    names = name_sensors({topic.name: topic.kind for topic in chosen})
    infos = [topic for topic in topics if topic.kind == "camera_info" and topic.count and not topic.problem]
    cameras = [topic for topic in chosen if KINDS[topic.kind].optical]
    sensors = [
        _Sensor(names[t.name], t, _find_camera_info(t, infos, len(cameras)) if t in cameras else None)
        for t in chosen
    ]
    triggers, too_many = find_triggers(topics)
    used = [*chosen, *(sensor.info for sensor in sensors), *triggers]
    for topic in topics:
        if topic not in used and topic.name not in unused:
            unused[topic.name] = _explain_unused(topic, often=topic in too_many)
    return sensors, unused


def _explain_unused(topic: FoundTopic, *, often: bool) -> str:
    if not topic.count:
        return "has no message"
    if topic.problem:
        return topic.problem
    if topic.kind == "camera_info":
        return "is of no camera whose images are used: neither its name nor its frame is that of one"
    if often:
        return "is not taken for a trigger, because it fires as often as a sensor"
    return "has not the name of a trigger: state it as capture.trigger if each of its messages marks a rest"


def _choose_topics(topics: Sequence[FoundTopic]) -> tuple[list[FoundTopic], dict[str, str]]:
    """The topics to draft sensors for, and why each other sensor topic is not one of them."""
    chosen: dict[str, FoundTopic] = {}
    skipped: dict[str, str] = {}
    for topic in sorted((t for t in topics if t.kind in KINDS), key=_preference_key):
        device = _device_name(topic)
        if not topic.count:
            skipped[topic.name] = "has no message"
        elif topic.problem:
            skipped[topic.name] = topic.problem
        elif topic.kind == "camera" and _DEPTH.search(topic.name):
            skipped[topic.name] = "seems to contain depth images"
        elif device in chosen:
            skipped[topic.name] = f"is the camera of {chosen[device].name}"
        else:
            chosen[device] = topic
    depths = [t for t in chosen.values() if KINDS[t.kind].convert and not _REGISTERED.search(t.name)]
    for device, topic in list(chosen.items()):
        if depths and KINDS[topic.kind].convert and _REGISTERED.search(topic.name):
            skipped[topic.name] = f"is {depths[0].name} in the view of another camera"
            del chosen[device]
    order = list(KINDS)
    return sorted(chosen.values(), key=lambda t: (order.index(t.kind), t.name)), skipped


def _device_name(topic: FoundTopic) -> str:
    """An identifier of the device, which all image topics of one camera share."""
    if not KINDS[topic.kind].optical:
        return topic.name
    images = _TRANSPORT.sub("", topic.name)
    space, _, last = images.rpartition("/")
    return f"{space}/" if space and last in _IMAGE_TOPICS else images


def _preference_key(topic: FoundTopic) -> tuple[int, bool, str]:
    """Sorts the topics of one camera: unrectified before rectified, lossless before compressed."""
    images = _TRANSPORT.sub("", topic.name)
    last = images.rpartition("/")[2]
    rank = _IMAGE_TOPICS.index(last) if last in _IMAGE_TOPICS else len(_IMAGE_TOPICS)
    return rank, images != topic.name, topic.name


def _find_camera_info(image: FoundTopic, infos: Sequence[FoundTopic], cameras: int) -> FoundTopic | None:
    """The camera_info of an image topic: beside it, in its frame, or the only one for the only camera."""
    images = _TRANSPORT.sub("", image.name)
    beside = (f"{images}/camera_info", f"{images.rpartition('/')[0]}/camera_info")
    by_name = next((info for name in beside for info in infos if info.name == name), None)
    in_frame = [info for info in infos if image.frame_id and info.frame_id == image.frame_id]
    alone = infos if cameras == 1 else []
    return by_name or (in_frame[0] if len(in_frame) == 1 else None) or (alone[0] if len(alone) == 1 else None)


def _head(recording: str, topics: Sequence[str] = (), *, ros: bool = False, board: bool = True) -> str:
    named = " ".join(shlex.quote(_single_line(name)) for name in topics)
    more = (
        "# To record more, and to mark each time from which on the board rests:\n"
        f"#   ros2 bag record -o RECORDING {named} /trigger\n"
        "#   ros2 topic pub --once /trigger std_msgs/msg/Empty\n"
    )
    return (
        f"# Drafted by calgraph init from the topics of {_single_line(recording)}.\n"
        f"# Go through the comments, {'state your board, ' if board else ''}then run\n"
        "#   calgraph calibrate rig.yaml RECORDING -o result\n"
        f"{more if ros else ''}"
    )


def _root(sensors: Sequence[_Sensor]) -> str:
    others = ", ".join(sensor.name for sensor in sensors[1:])
    hint = f"; could be {others}" if others else "; a calibration needs a second sensor"
    return f"# The sensor in whose frame everything is expressed{hint}.\nroot: {_format_scalar(sensors[0].name)}\n"


def _missing_target(sensors: Sequence[_Sensor]) -> str:
    """Comments in place of a target."""
    kinds = {sensor.topic.kind for sensor in sensors}
    return _NO_TARGET + (_NO_TARGET_OF_SCANNERS if kinds in ({"lidar2d"}, {"lidar3d"}) else "")


def _capture(
    topics: Sequence[FoundTopic], background: FoundBackground | None, mode: tuple[CaptureMode, str] | None
) -> str:
    triggers, _ = find_triggers(topics)
    window = (
        f"background: [0.0, {background.end:.1f}]      # CHECK: s from the start, without board and operator: "
        f"{_single_line(background.entry)}"
        if background
        else _NO_BACKGROUND
    )
    if background and not background.searched:
        # A calibration, which has the board, finds the window again and compares it with the images.
        window, background = f"# {window}; used unless a camera detects the board in it", None
    if not triggers and mode and mode[0] in _MODES:
        why = f"# CHECK: {_single_line(mode[1])}: {_MODES[mode[0]]}."
        lines = [why, "capture:", f"  mode: {mode[0]}", f"  {window}"]
    elif not triggers:
        lines = [
            "# No trigger topic was found: captures are found by the board resting.",
            "capture:" if background else "# capture:",
            f"{'' if background else '# '}  {window.removeprefix('# ')}",
            "#   trigger: /topic             # every message starts a capture: the board rests from there on",
        ]
    else:
        name, count = triggers[0].name, triggers[0].count
        lines = [
            f"# CHECK that each message of the trigger ({count} found) marks a time from when on the board rests;",
            "# without a trigger the holds are found from the data.",
            "capture:",
            f"  trigger: {_format_scalar(name)}",
            *(f"  # trigger: {_format_scalar(other.name)}" for other in triggers[1:]),
            f"  {window}",
        ]
    return "\n".join([*lines, ""])


def find_triggers(topics: Sequence[FoundTopic]) -> tuple[list[FoundTopic], list[FoundTopic]]:
    """Topics whose messages could start captures, and those that rather fire with every image."""
    named = [t for t in topics if t.kind == "event" and t.count and _TRIGGER.search(t.name)]
    often = max((t.count for t in topics if t.kind in KINDS), default=0) / 2
    plausible = [topic for topic in named if topic.count < often]
    return plausible, [topic for topic in named if topic not in plausible]


def _sensors(sensors: Sequence[_Sensor]) -> str:
    head = [
        "# Names are free to choose. noise: standard deviations to begin with, of corners (px) or beams (m, rad).",
        "sensors:",
    ]
    root = sensors[0]
    own_clocks = [sensor for sensor in sensors if sensor.topic.own_clock or root.topic.own_clock]
    lines = [line for sensor in sensors for line in _sensor(sensor, sensor in own_clocks and sensor is not root)]
    return "\n".join([*head, *lines, ""])


def _sensor(sensor: _Sensor, own_clock: bool) -> list[str]:
    topic = sensor.topic
    lines = [
        f"  {_format_scalar(sensor.name)}:",
        f"    kind: {topic.kind}",
        f"    topic: {_format_scalar(topic.name)}  # {topic.count} messages",
    ]
    if sensor.info:
        lines.append(f"    camera_info: {_format_scalar(sensor.info.name)}")
    elif KINDS[topic.kind].convert:
        lines.append("    # CHANGE: state camera_info (a topic) or intrinsics; no usable camera_info was found")
    elif topic.kind == "camera":
        lines += [
            _NO_INTRINSICS_OF_CORNERS if topic.type == "corners" else _NO_INTRINSICS,
            "    # intrinsics: {width: 1280, height: 960, K: [900.0, 900.0, 639.5, 479.5], distortion: []}",
        ]
    if own_clock:
        lines.append("    clock_offset: estimate      # from the motion of the board; leave it out for one clock")
    if KINDS[topic.kind].detects == "motion":
        return [*lines, "    # frame_id: name            # the frame that moves; exports need it"]
    if topic.frame_id:
        lines.append(f"    frame_id: {_format_scalar(topic.frame_id)}")
    else:
        lines.append("    # frame_id: name            # its messages name none; exports need it")
    return [*lines, f"    noise: {KINDS[topic.kind].drafted_noise}"]


def _unused_topics(topics: Sequence[FoundTopic], unused: Mapping[str, str]) -> str:
    lines = [f"#   {line}" for line in _list_unused(topics, unused)]
    return "\n".join(["# Also in the recording, but not used:", *lines, ""]) if lines else ""


def _list_unused(topics: Sequence[FoundTopic], unused: Mapping[str, str]) -> list[str]:
    """A line for each topic that is not used: its name, its type and why."""
    reasons = [(topic, unused[topic.name]) for topic in topics if topic.name in unused]
    return [
        _single_line(f"{topic.name}{'' if topic.type in reason else f' ({topic.type})'}: {reason}")
        for topic, reason in reasons
    ]


def _format_scalar(text: str) -> str:
    """A text as YAML reads it back."""
    return text if _PLAIN.fullmatch(text) else json.dumps(text, ensure_ascii=False)


def _single_line(text: str) -> str:
    """The text on one line, so that it cannot end the comment around it."""
    return " ".join(text.split())


_GENERIC_PART = re.compile(
    r"compressed(Depth)?|images?(_raw|_color|_mono|_rect|_rect_color|_rect_raw)?|raw|(laser_?)?scans?|(multi)?echo(es)?|first|data|"
    r"(point_?)?clouds?2?|points2?|packets|sensors?"
)
_AFFIX = re.compile(
    r"^(scan|points|cloud|image(_raw)?)_(?=.)|(?<=.)_(scan|points2?|(point_?)?cloud2?|image(_raw)?|compressed)$"
)


def name_sensors(kinds: Mapping[str, str]) -> dict[str, str]:
    """A name for each sensor's topic.

    ``/camera/image_raw`` becomes ``camera``, ``/scan`` becomes ``laser``, ``/left/camera/image`` and
    ``/right/camera/image`` become ``left_camera`` and ``right_camera``.

    Args:
        kinds: kind of sensor by topic.
    """
    parts = {topic: _specific_parts(topic) for topic in kinds}
    depth = dict.fromkeys(kinds, 1)
    names = {topic: _join_last(parts[topic], 1) or KINDS[kind].default_name for topic, kind in kinds.items()}
    while deeper := [t for t in _ambiguous_topics(names) if depth[t] < len(parts[t])]:
        for topic in deeper:
            depth[topic] += 1
            names[topic] = _join_last(parts[topic], depth[topic])
    for topic in _ambiguous_topics(names):
        names[topic] = f"{names[topic]}_{KINDS[kinds[topic]].default_name}"
    return _number_duplicates(names)


def _specific_parts(topic: str) -> list[str]:
    """The parts of a topic that are not generic names of its data."""
    parts = [re.sub(r"\W+", "_", part).strip("_") for part in topic.split("/")]
    return [_AFFIX.sub("", part) for part in parts if part and not _GENERIC_PART.fullmatch(part)]


def _join_last(parts: list[str], depth: int) -> str:
    return "_".join(parts[-depth:])


def _ambiguous_topics(names: Mapping[str, str]) -> list[str]:
    """The topics whose name is not unique."""
    counts = Counter(names.values())
    return [topic for topic, name in names.items() if counts[name] > 1]


def _number_duplicates(names: Mapping[str, str]) -> dict[str, str]:
    """The names, with a number after each that was given before."""
    taken: set[str] = set()
    numbered = {}
    for topic, name in names.items():
        candidates = (f"{name}_{n}" if n > 1 else name for n in range(1, len(names) + 2))
        numbered[topic] = next(c for c in candidates if c not in taken)
        taken.add(numbered[topic])
    return numbered
