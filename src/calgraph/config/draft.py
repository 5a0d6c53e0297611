"""A first rig.yaml from the topics of a recording, with comments on what to check and what to measure."""

import json
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from calgraph.config.rig_config import DRIVE_KINDS, CaptureMode
from calgraph.errors import InputError
from calgraph.sensors.kinds import KINDS, TF_TYPES, KindName, motion_kind_of

if TYPE_CHECKING:
    from jinja2 import Template

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
    optional: list[_Sensor] = []
    if drive:
        sensors, optional, left_out = _choose_for_drive(sensors)
        unused = {**unused, **left_out}
    elif not sensors:
        found = "; ".join(_list_unused(topics, unused)) or "none"
        raise InputError(
            f"{recording}: has no topic with usable images, laser scans or point clouds; its topics are: {found}"
        )
    board = not (drive or network)
    # Of a network, the first is a 3-D LiDAR, which measures the floor.
    roots = [one.name for one in sensors if not network or one.topic.kind in ("lidar3d", "lidar2d")]
    recorded = [topic.name for one in sensors for topic in (one.topic, one.info) if topic and board]
    has_ros_topics = any("/" in one.topic.type for one in sensors)
    return _load_template().render(
        recording=recording,
        board=board,
        recorded=" ".join(shlex.quote(_single_line(name)) for name in recorded if has_ros_topics),
        roots=[*roots, "floor"] if network else roots,
        drive=drive,
        network=network,
        target=target,
        triggers=find_triggers(topics)[0],
        mode=mode,
        background=background,
        sensors=sensors,
        kinds=KINDS,
        optional=optional,
        unused=_list_unused(topics, unused),
    )


def _load_template() -> "Template":
    from jinja2 import Environment, PackageLoader, StrictUndefined  # of few commands

    environment = Environment(
        loader=PackageLoader("calgraph.config"),
        undefined=StrictUndefined,
        autoescape=False,  # no HTML
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"scalar": _format_scalar, "line": _single_line}
    return environment.get_template("rig.yaml.jinja")


def _claim_motion(topic: FoundTopic) -> FoundTopic:
    """The topic as that of a kind that is calibrated in a drive only, if it is one; tf has several frames."""
    kind = motion_kind_of(topic.type)
    if topic.type in TF_TYPES:
        return replace(topic, problem="kind: trajectory with frame_id and parent takes the poses of one frame")
    return replace(topic, kind=kind, problem="") if kind else topic


def _choose_for_drive(sensors: Sequence[_Sensor]) -> tuple[list[_Sensor], list[_Sensor], dict[str, str]]:
    """The sensors of a robot that drives, those that can take part, too, and why topics of others are not used.

    The second may be redundant, as an odometry beside two scanners, or need boards in the room.
    """
    scanners = [one for one in sensors if one.topic.kind in ("lidar2d", "lidar3d")]
    motions = [one for one in sensors if KINDS[one.topic.kind].detects == "motion"]
    cameras = [one for one in sensors if one.topic.kind == "camera"]
    used = scanners if len(scanners) > 1 else [*scanners, *motions]
    others = [one.topic.name for one in sensors if one.topic.kind not in DRIVE_KINDS]
    left_out = dict.fromkeys(others, "is of a kind that a drive does not calibrate")
    return used, [one for one in [*motions, *cameras] if one not in used], left_out


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


def find_triggers(topics: Sequence[FoundTopic]) -> tuple[list[FoundTopic], list[FoundTopic]]:
    """Topics whose messages could start captures, and those that rather fire with every image."""
    named = [t for t in topics if t.kind == "event" and t.count and _TRIGGER.search(t.name)]
    often = max((t.count for t in topics if t.kind in KINDS), default=0) / 2
    plausible = [topic for topic in named if topic.count < often]
    return plausible, [topic for topic in named if topic not in plausible]


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
