"""The empty start of a recording: the time before the board and its operator enter the views of the scanners."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.boards.printed_boards import PrintedBoard, make_printed_boards, select_grays
from calgraph.config import Board, Capture, Rig
from calgraph.config.settings import CameraDetectionSettings, CaptureSettings
from calgraph.geometry import Array, measure_lengths
from calgraph.recording import NO_CACHE, PoseRecordings, Recording, RecordingCache
from calgraph.result.finding import Finding
from calgraph.rig.captures.capture_mode import recognize_mode
from calgraph.rig.captures.timeline import build_timeline
from calgraph.rig.detection.capture_background import Cells, find_direction_cells, find_local_maxima
from calgraph.sensors import DetectedCorners, Image, LaserScan, Message, PointCloud, RecordedMessage
from calgraph.sensors.kinds import KINDS

_EMPTY_START = "empty start/2"
_MIN_REFERENCE_MESSAGES = 3
"""Messages of a scanner that show what is static: with two, neither an outlier nor a change is recognized."""
_MAX_PAUSE = 3.0
"""Pause of a scanner over its median period after which it does not show an entry; one lost message makes 2."""
_IMAGES = 8
"""Images of each camera in which the board is searched for, spread over the empty start: a board that enters the
view of a camera first is in it for seconds."""


@dataclass(frozen=True)
class EmptyStart:
    """The time at the start of a recording in which nothing moved, before something entered."""

    end: float
    """Its end, s from the start of the recording."""
    entry: float
    """When something entered, s from the start of the recording."""
    topic: str
    """Of the scanner that detected it first."""


def resolve_background(
    rig: Rig, recording: Recording, cache: RecordingCache = NO_CACHE
) -> tuple[Rig, tuple[Finding, ...]]:
    """The rig with the empty start of the recording as background window, where it has a board and states none.

    Args:
        rig: the rig.
        recording: is searched, unless the cache has what was found.
        cache: of earlier runs.

    Returns:
        The rig, and a finding that states the window if one was found.
    """
    if rig.is_network or rig.capture.background is not None or isinstance(recording, PoseRecordings):
        return rig, ()
    scanners = [spec.topic for spec in rig.sensors.values() if KINDS[spec.kind].measures_ranges]
    cameras = [spec.topic for spec in rig.sensors.values() if not KINDS[spec.kind].measures_ranges]
    settings = rig.settings
    inputs = {
        "scanners": scanners,
        "cameras": cameras,
        "capture": rig.capture,
        "boards": [board.model_dump(mode="json", exclude={"uncertainty"}) for board in rig.boards],
        "settings": [settings.captures, settings.detection.camera],
    }
    kept = cache.read(recording, _EMPTY_START, inputs, (EmptyStart,))
    if kept:
        (start,) = kept
    else:
        start = find_empty_start(
            recording, scanners, cameras, rig.boards, rig.capture, settings.captures, settings.detection.camera
        )
        cache.write(recording, _EMPTY_START, inputs, (start,))
    if start is None:
        return rig, ()
    names = [name for name, spec in rig.sensors.items() if KINDS[spec.kind].measures_ranges]
    finding = Finding(
        f"rig.yaml states no capture.background: 0.0 to {start.end:.1f} s from the start were found to be without "
        f"board and operator, as nothing changes before {start.topic} does at {start.entry:.1f} s; what "
        f"{', '.join(names)} detect{'s' if len(names) == 1 else ''} depends on it: state this window, or another"
    )
    capture = rig.capture.model_copy(update={"background": (0.0, start.end)})
    return rig.model_copy(update={"capture": capture}), (finding,)


# Time from the start that is searched, s: operators who wait longer state a window in rig.yaml. 0: none.
_MAX_DURATION = 60.0
# Minimum duration of an empty start, s: a background needs several messages of each scanner.
_MIN_DURATION = 1.5


def find_empty_start(
    recording: Recording,
    scanners: Sequence[str],
    cameras: Sequence[str],
    boards: Sequence[Board],
    capture: Capture,
    settings: CaptureSettings,
    camera_settings: CameraDetectionSettings,
) -> EmptyStart | None:
    """Finds the time before anything enters the view of a scanner.

    A scanner's view was empty at the start if something later appears in front of what it measured then, and if
    later measurements do not reach beyond it: a board or person that was in view at the start uncovers the room
    when it moves. It was not empty where a camera detects the board, or from a trigger on. Snapshots and
    a scanner that pauses do not show when something entered.

    Args:
        recording: to search.
        scanners: topics of the scanners.
        cameras: topics of the cameras.
        boards: that cameras can detect; none if they are not known.
        capture: what is known of the captures.
        settings: of the search for captures.
        camera_settings: of the search for boards in images.

    Returns:
        The empty start; None if there is none, if it is too short, or if nothing enters.
    """
    if not scanners:
        return None
    start = recording.start
    records = recording.records(scanners, start, start + _MAX_DURATION)
    found = _find_entry(records, start)
    if found is None or found.end < _MIN_DURATION:
        return None
    if _is_uncovered_later(recording, scanners):
        return None
    topics = [*scanners, *cameras]
    stamps = build_timeline(recording.records(topics), start, {topic: topic for topic in topics}, None)
    if recognize_mode(stamps, capture, settings).mode == "snapshots":
        return None
    printed = make_printed_boards(boards, camera_settings)
    triggers = recording.records([capture.trigger]) if capture.trigger else ()
    ends = [_find_board_entry(recording, camera, found.end, printed) for camera in cameras]
    ends += [record.arrival - start for record in triggers]
    end = min([found.end, *map(_round_down, ends)])
    return replace(found, end=end) if end >= _MIN_DURATION else None


def _find_board_entry(recording: Recording, camera: str, end: float, printed: Sequence[PrintedBoard]) -> float:
    """Until when a camera does not detect the board, s from the start of the recording: at most ``end``."""
    start = recording.start
    arrivals = [record.arrival for record in recording.records([camera], start, start + end)]
    chosen = set(np.array(arrivals)[np.unique(np.linspace(0, len(arrivals) - 1, _IMAGES).round().astype(int))])
    empty_until = 0.0
    for record in recording.records([camera], start, start + end) if arrivals else ():
        if record.arrival in chosen:
            if _shows_board(record.decode(), printed):
                return empty_until
            empty_until = record.arrival - start
    return end


def _shows_board(message: Message, printed: Sequence[PrintedBoard]) -> bool:
    if isinstance(message, DetectedCorners):
        return len(message.pixels) > 0
    if not isinstance(message, Image):
        return False
    grays = select_grays(printed, [message.gray])
    return any(
        np.isin(one.finder.find(gray).ids, one.landmarks.ids).any()
        for one in printed
        for gray in grays[one.finder]
    )


# Edge of the cells in which directions are compared, 1°: several beams of any LiDAR.
_DIRECTION_CELL = 0.0174532925199433
# Time at the start that later measurements are compared with, s: several messages of any scanner.
_REFERENCE_DURATION = 1.0
# Change of a range, m, that is something else: ten times the noise of a scanner; people and boards are farther
# than this from walls.
_MIN_RANGE_CHANGE = 0.2
# The same over the range: noise of directions and of angles of incidence grows with it.
_MIN_RANGE_CHANGE_RATIO = 0.02


class _Reference:
    """Nearest and farthest ranges by direction, of the first messages of one scanner."""

    def __init__(self) -> None:
        self._shape = round(np.pi / _DIRECTION_CELL), round(2 * np.pi / _DIRECTION_CELL)
        self._nearest = np.full(self._shape, np.inf)
        self._farthest = np.full(self._shape, -np.inf)
        self._around: tuple[Array, Array] | None = None
        self._messages = 0

    def is_complete(self, time: float) -> bool:
        """Whether a message at a time, s from the start of the recording, is compared with those before."""
        return self._messages >= _MIN_REFERENCE_MESSAGES and time >= _REFERENCE_DURATION

    def add(self, message: Message) -> None:
        """Adds a message."""
        self._messages += 1
        cells, ranges = self._measure(message)
        np.minimum.at(self._nearest, cells, ranges)
        np.maximum.at(self._farthest, cells, ranges)
        self._around = None

    def count_nearer(self, message: Message) -> int:
        """Number of directions in which a message has something in front of everything around them."""
        nearest, margin = self._find_nearest(message)
        return int(np.sum(np.isfinite(nearest) & (nearest < self._find_range_around()[0] - margin)))

    def count_beyond(self, message: Message) -> int:
        """Number of directions in which a message measures only what is behind everything around them."""
        nearest, margin = self._find_nearest(message)
        known = np.isfinite(nearest) & np.isfinite(self._farthest)
        return int(np.sum(known & (nearest > self._find_range_around()[1] + margin)))

    def _find_range_around(self) -> tuple[Array, Array]:
        """Nearest and farthest range in each direction and those next to it."""
        if self._around is None:
            self._around = -find_local_maxima(-self._nearest), find_local_maxima(self._farthest)
        return self._around

    def _find_nearest(self, message: Message) -> tuple[Array, Array]:
        """Nearest range by direction, infinite without returns; and by how much another one differs at least."""
        nearest = np.full(self._shape, np.inf)
        np.minimum.at(nearest, *self._measure(message))
        finite = np.where(np.isfinite(nearest), nearest, 0.0)
        return nearest, np.maximum(_MIN_RANGE_CHANGE, _MIN_RANGE_CHANGE_RATIO * finite)

    def _measure(self, message: Message) -> tuple[Cells, Array]:
        """Direction and range of each return."""
        points = _list_points(message)
        return find_direction_cells(points, self._shape), measure_lengths(points)


def _list_points(message: Message) -> Array:
    """(N, 3) finite points, scanner frame, m."""
    if isinstance(message, LaserScan):
        return np.asarray(message.points[message.valid])
    if isinstance(message, PointCloud):
        finite = np.isfinite(message.points)
        return message.points if finite.all() else np.asarray(message.points[finite.all(axis=1)])
    return np.zeros((0, 3))


# Minimum number of cells with something else: an object of 0.5 m at 10 m covers three in a row.
_MIN_DIRECTIONS = 3
# Time between the empty start and the detected entry, s: at 1 m/s, less than half of a person is in view.
_ENTRY_MARGIN = 0.3


def _find_entry(records: Iterable[RecordedMessage], start: float) -> EmptyStart | None:
    """The first entry of something into the view of a scanner, in two successive messages of it."""
    references: dict[str, _Reference] = defaultdict(_Reference)
    times: dict[str, list[float]] = defaultdict(list)
    entered: dict[str, float] = {}
    for record in records:
        time, topic, message = record.arrival - start, record.topic, record.decode()
        times[topic].append(time)
        if not references[topic].is_complete(time):
            references[topic].add(message)
        elif references[topic].count_nearer(message) < _MIN_DIRECTIONS:
            entered.pop(topic, None)
        elif topic not in entered:
            entered[topic] = time
        else:
            first = min(entered, key=lambda one: entered[one])
            periods = np.diff(times[first])
            before = periods[: times[first].index(entered[first])]
            if (before > _MAX_PAUSE * np.median(periods)).any():
                return None
            return EmptyStart(_round_down(entered[first] - _ENTRY_MARGIN), entered[first], first)
    return None


def _round_down(time: float) -> float:
    """A time to tenths of a second, as it is written in rig.yaml."""
    return float(np.floor(10 * time)) / 10


# Messages of each scanner that are searched for what was uncovered, spread over the recording.
_LATER_MESSAGES = 20
# Share of these beyond which something was in view at the start: what left its place uncovers the room in most of
# them; people who pass cover others.
_MAX_UNCOVERED_SHARE = 0.5


def _is_uncovered_later(recording: Recording, topics: Sequence[str]) -> bool:
    """Whether a scanner later measures beyond what was in its view at the start, in most of the recording."""
    references: dict[str, _Reference] = defaultdict(_Reference)
    beyond: dict[str, list[bool]] = {topic: [] for topic in topics}
    interval = (recording.end - recording.start) / _LATER_MESSAGES
    due = dict.fromkeys(topics, recording.start + _REFERENCE_DURATION)
    for record in recording.records(topics):
        topic = record.topic
        if not references[topic].is_complete(record.arrival - recording.start):
            references[topic].add(record.decode())
        elif record.arrival >= due[topic]:
            due[topic] = record.arrival + interval
            beyond[topic].append(references[topic].count_beyond(record.decode()) >= _MIN_DIRECTIONS)
    return any(np.mean(found) > _MAX_UNCOVERED_SHARE for found in beyond.values() if found)
