"""Short, readable and unique names for sensors, from their topics."""

import re
from collections import Counter
from collections.abc import Mapping

from calgraph.sensors.kinds import KINDS

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
