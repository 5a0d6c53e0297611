"""The empty start of a recording: the time before the board and its operator enter the views of the scanners."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.config import CameraSpec, Rig
from calgraph.config.settings import EmptyStartSettings
from calgraph.detection.cloud_background import Cells, find_direction_cells, find_local_maxima
from calgraph.geometry import Array, measure_lengths
from calgraph.recording import NO_CACHE, Recording, RecordingCache
from calgraph.sensors import LaserScan, Message, PointCloud, RecordedMessage

_EMPTY_START = "empty start/1"


@dataclass(frozen=True)
class EmptyStart:
    """The time at the start of a recording in which nothing moved, before something entered."""

    end: float
    """Its end, s from the start of the recording."""
    entry: float
    """When something entered, s from the start of the recording."""
    topic: str
    """Of the scanner that detected it first."""


def resolve_background(rig: Rig, recording: Recording, cache: RecordingCache = NO_CACHE) -> Rig:
    """The rig with the empty start of the recording as background window, where it has a board and states none.

    Args:
        rig: the rig.
        recording: is searched, unless the cache has what was found.
        cache: of earlier runs.
    """
    if rig.is_network or rig.capture.background is not None:
        return rig
    scanners = [spec.topic for spec in rig.sensors.values() if not isinstance(spec, CameraSpec)]
    settings = rig.settings.captures.empty_start
    inputs = {"topics": scanners, "settings": settings}
    end = cache.read(recording, _EMPTY_START, inputs, lambda content, _: float(content["end"]))
    if end is None:
        found = find_empty_start(recording, scanners, settings)
        end = found.end if found else 0.0
        cache.write(recording, _EMPTY_START, inputs, {"end": end}, {})
    if not end:
        return rig
    return rig.model_copy(update={"capture": rig.capture.model_copy(update={"background": (0.0, end)})})


def find_empty_start(
    recording: Recording, topics: Sequence[str], settings: EmptyStartSettings
) -> EmptyStart | None:
    """Finds the time before anything enters the view of a scanner.

    A scanner's view was empty at the start if something later appears in front of what it measured then, and if
    later measurements do not reach beyond it: a board or person that was in view at the start uncovers the room
    when it moves.

    Args:
        recording: to search.
        topics: of the scanners.
        settings: of the search.

    Returns:
        The empty start; None if there is none, if it is too short, or if nothing enters.
    """
    if not topics:
        return None
    start = recording.start
    until = start + settings.max_duration
    found = _find_entry(recording.records(topics, start, until), start, settings)
    if found is None or found.end < settings.min_duration or _is_uncovered_later(recording, topics, settings):
        return None
    return found


class _Reference:
    """Nearest and farthest ranges by direction, of the first messages of one scanner."""

    def __init__(self, settings: EmptyStartSettings) -> None:
        self._settings = settings
        self._shape = round(np.pi / settings.direction_cell), round(2 * np.pi / settings.direction_cell)
        self._nearest = np.full(self._shape, np.inf)
        self._farthest = np.full(self._shape, -np.inf)
        self._around: tuple[Array, Array] | None = None

    def add(self, message: Message) -> None:
        """Adds a message."""
        cells, ranges = self._measure(message)
        np.minimum.at(self._nearest, cells, ranges)
        np.maximum.at(self._farthest, cells, ranges)
        self._around = None

    def count_nearer(self, message: Message) -> int:
        """Number of directions in which a message has something in front of everything around them."""
        nearest = self._find_nearest(message)
        reference = self._find_range_around()[0] - self._margin(nearest)
        return int(np.sum(np.isfinite(nearest) & (nearest < reference)))

    def count_beyond(self, message: Message) -> int:
        """Number of directions in which a message measures only what is behind everything around them."""
        nearest = self._find_nearest(message)
        reference = self._find_range_around()[1] + self._margin(nearest)
        return int(np.sum(np.isfinite(nearest) & np.isfinite(self._farthest) & (nearest > reference)))

    def _find_range_around(self) -> tuple[Array, Array]:
        """Nearest and farthest range in each direction and those next to it."""
        if self._around is None:
            self._around = -find_local_maxima(-self._nearest), find_local_maxima(self._farthest)
        return self._around

    def _margin(self, ranges: Array) -> Array:
        settings = self._settings
        finite = np.where(np.isfinite(ranges), ranges, 0.0)
        return np.asarray(np.maximum(settings.min_range_change, settings.min_range_change_ratio * finite))

    def _find_nearest(self, message: Message) -> Array:
        """Nearest range by direction; infinite without returns."""
        nearest = np.full(self._shape, np.inf)
        np.minimum.at(nearest, *self._measure(message))
        return nearest

    def _measure(self, message: Message) -> tuple[Cells, Array]:
        """Direction and range of each return."""
        points = _list_points(message)
        return find_direction_cells(points, self._shape), measure_lengths(points)


def _list_points(message: Message) -> Array:
    """(N, 3) finite points, scanner frame, m."""
    if isinstance(message, LaserScan):
        angles, ranges = message.angles[message.valid], message.ranges[message.valid]
        return np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles), np.zeros(len(ranges))])
    if isinstance(message, PointCloud):
        finite = np.isfinite(message.points)
        return message.points if finite.all() else np.asarray(message.points[finite.all(axis=1)])
    return np.zeros((0, 3))


def _find_entry(
    records: Iterable[RecordedMessage], start: float, settings: EmptyStartSettings
) -> EmptyStart | None:
    """The first entry of something into the view of a scanner, in two successive messages of it."""
    references: dict[str, _Reference] = {}
    entered: dict[str, float] = {}
    for record in records:
        time, topic, message = record.arrival - start, record.topic, record.decode()
        if topic not in references or time < settings.reference_duration:
            references.setdefault(topic, _Reference(settings)).add(message)
        elif references[topic].count_nearer(message) < settings.min_directions:
            entered.pop(topic, None)
        elif topic not in entered:
            entered[topic] = time
        else:
            first = min(entered, key=lambda one: entered[one])
            return EmptyStart(_round_down(entered[first] - settings.entry_margin), entered[first], first)
    return None


def _round_down(time: float) -> float:
    """A time to tenths of a second, as it is written in rig.yaml."""
    return float(np.floor(10 * time)) / 10


def _is_uncovered_later(recording: Recording, topics: Sequence[str], settings: EmptyStartSettings) -> bool:
    """Whether a scanner later measures beyond what was in its view at the start, in most of the recording."""
    references: dict[str, _Reference] = {}
    beyond: dict[str, list[bool]] = {topic: [] for topic in topics}
    interval = (recording.end - recording.start) / settings.later_messages
    due = dict.fromkeys(topics, recording.start + settings.reference_duration)
    for record in recording.records(topics):
        topic = record.topic
        if topic not in references or record.arrival < recording.start + settings.reference_duration:
            references.setdefault(topic, _Reference(settings)).add(record.decode())
        elif record.arrival >= due[topic]:
            due[topic] = record.arrival + interval
            beyond[topic].append(references[topic].count_beyond(record.decode()) >= settings.min_directions)
    return any(np.mean(found) > settings.max_uncovered_share for found in beyond.values() if found)
