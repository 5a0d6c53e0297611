"""The messages of holds for calls of an engine, sent with each call or read by it, and their previews."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Rig
from calgraph.geometry import Array
from calgraph.parallel.engine import THIS_PROCESS, Engine, Processes
from calgraph.parallel.kept_values import Kept
from calgraph.recording import Recording, RecordingReference, refer_to
from calgraph.result import Snapshot
from calgraph.rig.captures.holds import Hold, sample_evenly
from calgraph.rig.captures.timeline import RecordingTimeline, SensorTimes
from calgraph.rig.kinds import RIG_KINDS
from calgraph.sensors import Image, LaserScan, Message, PointCloud, RecordedMessage


@dataclass(frozen=True)
class PreviewSize:
    """The size of the preview of one message."""

    width: int
    """Largest width of an image, px."""
    points: int
    """Most points of a cloud or scan."""


# Small previews suffice to recognise a capture; large ones, of captures spread evenly, show all detail.
_LARGE, _SMALL = PreviewSize(640, 8000), PreviewSize(160, 600)
# Most captures with large previews, and bytes of all large and of all small ones.
_MAX_LARGE = 60
_BUDGETS = {_LARGE: 14e6, _SMALL: 4e6}
_QUALITY = 80
_GOLDEN = (np.sqrt(5) - 1) / 2


def plan_previews(holds: Sequence[Hold], rig: Rig) -> dict[int, PreviewSize]:
    """The size of the previews by capture; captures beyond the budget, spread evenly, have none.

    Of a rig without sensors, as none can detect the board, there are none.
    """
    if not rig.sensors:
        return {}
    limits = {size: int(budget / _estimate_bytes(size, rig)) for size, budget in _BUDGETS.items()}
    large = sample_evenly(np.arange(len(holds)), min(_MAX_LARGE, limits[_LARGE]))
    small = sample_evenly(np.setdiff1d(np.arange(len(holds)), large), limits[_SMALL])
    chosen = dict.fromkeys(large.tolist(), _LARGE) | dict.fromkeys(small.tolist(), _SMALL)
    return {hold.index: chosen[k] for k, hold in enumerate(holds) if k in chosen}


def _estimate_bytes(size: PreviewSize, rig: Rig) -> float:
    """Estimated bytes of the previews of one capture of all sensors."""
    kinds = (RIG_KINDS[spec.kind] for spec in rig.sensors.values())
    return sum(kind.preview_bytes(size.width, size.points) for kind in kinds)


def make_preview(capture: int, sensor: str, messages: Sequence[Message], size: PreviewSize) -> Snapshot:
    """A preview of the middle one of a sensor's messages of one capture."""
    message = messages[len(messages) // 2]
    preview = Snapshot(capture, sensor, message.stamp)
    if isinstance(message, Image):
        h, w = message.pixels.shape[:2]
        return replace(preview, image=_encode_jpeg(message.pixels, size.width), width=w, height=h)
    if isinstance(message, LaserScan | PointCloud):
        points = message.points[message.valid] if isinstance(message, LaserScan) else message.points
        return replace(preview, points=_subsample_points(points, size.points))
    return preview


def _encode_jpeg(pixels: NDArray[np.uint8], width: int) -> bytes:
    import cv2

    h, w = pixels.shape[:2]
    if w > width:
        # Area averages do not alias the fine pattern of a board.
        pixels = cv2.resize(pixels, (width, max(round(h * width / w), 1)), interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()


def _subsample_points(points: Array, limit: int) -> NDArray[np.float32]:
    """At most ``limit`` of points (N, 3), spread evenly over their order.

    A constant stride would alias with the order of rings of a LiDAR and leave some rings out: the place within
    each stride varies by the golden ratio, a low-discrepancy sequence.
    """
    if len(points) > limit:
        stride = len(points) / limit
        offsets = (np.arange(limit) * _GOLDEN) % 1
        points = points[((np.arange(limit) + offsets) * stride).astype(np.intp)]
    return points.astype(np.float32)


Result = TypeVar("Result")
Search = tuple[int, str]
"""Capture and sensor."""
SearchMessages = tuple[int, str, list[Callable[[], Message]], PreviewSize | None]
"""Capture, sensor, functions that decode its messages, and the size of their preview."""

# A worker opens the recording for each part, which takes as long as one message takes to be searched. With four
# parts for each worker, few wait for the last one.
_PARTS_PER_WORKER = 4
# Fewer searches of messages that are sent than these, of about 20 ms, end before other processes help.
_MIN_PARALLEL_SEARCHES = 16
# Larger than the error of a time of this century in floating point, s.
_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class StoredMessages:
    """The messages of a recording, for calls that read a part of it themselves."""

    reference: RecordingReference
    timeline: RecordingTimeline
    """When they arrived, by sensor."""


Messages = Iterable[RecordedMessage] | StoredMessages
"""Records of sensors, streamed; or where calls find them."""


def select_messages(
    rig: Rig, recording: Recording, timeline: RecordingTimeline, engine: Engine
) -> StoredMessages | None:
    """Where calls of the engine read the messages of the rig's sensors; None if these are to be sent to them.

    To a cluster, messages that are sent pass through this process and the scheduler; processes of this machine get
    them as fast as they would read them. Where reading a part takes as long as reading all, messages are always
    sent: of videos, which are decoded from a keyframe on, files that are compressed as a whole or have no index,
    detected corners, recordings of one pose each, and of messages in memory.
    """
    if isinstance(engine, Processes) or not (recording.divisible and recording.opened_from):
        return None
    return StoredMessages(refer_to(recording, rig.settings.limits), timeline)


def count_parts(engine: Engine) -> int:
    """The number of parts of a recording that calls of the engine read."""
    return _PARTS_PER_WORKER * max(engine.workers, 1)  # a cluster may have lost all for a moment


def search_holds(
    search: Callable[..., Result],
    shared: Any,
    messages: Messages,
    holds: Sequence[Hold],
    topics: Mapping[str, str],
    *,
    engine: Engine = THIS_PROCESS,
    preview_sizes: Mapping[int, PreviewSize] | None = None,
    skipped: Collection[Search] = (),
    progress: Callable[[int], None] = lambda _done: None,
) -> Iterator[Result]:
    """Calls a function once per capture and sensor, with the messages of few captures in memory at a time.

    Args:
        search: defined at module level; called with ``shared`` and the items of :data:`SearchMessages`.
        shared: first argument of all calls.
        messages: of all sensors.
        holds: with the stamps of the messages to use.
        topics: topic by sensor.
        engine: runs the calls.
        preview_sizes: by capture; those that are not in it have none.
        skipped: captures and sensors that are left out.
        progress: called with the number of captures and sensors done.

    Yields:
        Results, which do not depend on the engine; those of one sensor in the order in which its captures were
        complete.

    Raises:
        RecordingError: the content of a message is unusable.
        CalibrationError: a process was killed.
    """
    sizes = preview_sizes or {}
    searched: Iterator[Result]
    if isinstance(messages, StoredMessages):
        parts = _divide(messages, holds, topics, skipped, count_parts(engine))
        given = Kept.of((messages.reference, search, shared, topics, sizes, skipped))
        searched = chain.from_iterable(engine.map(_search_part, [(given, *part) for part in parts]))
    else:
        engine = engine if len(holds) * len(topics) >= _MIN_PARALLEL_SEARCHES else THIS_PROCESS
        given = Kept.of(shared)
        gathered = gather_messages(messages, holds, topics, sizes, skipped)
        searched = engine.map(search, ((given, *one) for one in gathered))
    for done, found in enumerate(searched, start=1):
        yield found
        progress(done)


def read_part(
    recording: Recording, topics: Collection[str], first: float, last: float
) -> Iterator[RecordedMessage]:
    """The records of topics that arrived from ``first`` to ``last``, s."""
    # A recording that shifts arrivals rounds the limits.
    for record in recording.records(topics, first - _ROUNDING, last + _ROUNDING):
        if first <= record.arrival <= last:
            yield record


def gather_messages(
    records: Iterable[RecordedMessage],
    holds: Sequence[Hold],
    topics: Mapping[str, str],
    preview_sizes: Mapping[int, PreviewSize],
    skipped: Collection[Search] = (),
) -> Iterator[SearchMessages]:
    """Every capture and sensor with functions that decode its messages, as soon as the last one has been read.

    Args:
        records: all records of the sensors, streamed.
        holds: with the stamps of the messages to use.
        topics: topic by sensor.
        preview_sizes: by capture; those that are not in it have none.
        skipped: captures and sensors that are left out.
    """
    sensor_by_topic = {topic: name for name, topic in topics.items()}
    captures_of_message: dict[tuple[str, float], list[int]] = {}
    missing_messages: dict[Search, int] = {}
    for hold in holds:
        for name in topics:
            if (hold.index, name) in skipped:
                continue
            chosen = hold.stamps[name]
            missing_messages[hold.index, name] = len(chosen)
            for stamp in chosen:
                captures_of_message.setdefault((name, float(stamp)), []).append(hold.index)
    received: dict[Search, list[Callable[[], Message]]] = {}
    for record in records:
        name = sensor_by_topic.get(record.topic, "")
        for capture in captures_of_message.pop((name, record.stamp), ()):
            key = capture, name
            received.setdefault(key, []).append(record.decode)
            missing_messages[key] -= 1
            if missing_messages[key] == 0:
                del missing_messages[key]
                yield capture, name, received.pop(key), preview_sizes.get(capture)
    for capture, name in missing_messages:
        yield capture, name, received.pop((capture, name), []), preview_sizes.get(capture)


def _search_part(
    given: tuple[
        RecordingReference,
        Callable[..., Result],
        Any,
        Mapping[str, str],
        Mapping[int, PreviewSize],
        Collection[Search],
    ],
    holds: Sequence[Hold],
    first: float,
    last: float,
) -> list[Result]:
    """Reads the messages of some holds, which arrived from ``first`` to ``last``, and searches them."""
    reference, search, shared, topics, sizes, skipped = given
    with reference.open() as recording:
        records = read_part(recording, topics.values(), first, last)
        return [search(shared, *work) for work in gather_messages(records, holds, topics, sizes, skipped)]


def _divide(
    messages: StoredMessages,
    holds: Sequence[Hold],
    topics: Mapping[str, str],
    skipped: Collection[Search],
    count: int,
) -> Iterator[tuple[list[Hold], float, float]]:
    """At most ``count`` parts: holds that follow each other, and when their first and last message arrived, s."""
    spans: dict[int, tuple[float, float]] = {}
    for hold in holds:
        names = [name for name in topics if (hold.index, name) not in skipped]
        if names:
            arrivals = np.concatenate(
                [_find_arrivals(messages.timeline.sensors[name], hold.stamps[name]) for name in names]
            )
            if not len(arrivals):
                # A hold without messages is as late as the end of the recording.
                arrivals = np.array([messages.reference.span[1]])
            spans[hold.index] = float(arrivals.min()), float(arrivals.max())
    ordered = sorted((hold for hold in holds if hold.index in spans), key=lambda hold: spans[hold.index])
    size = max(-(-len(ordered) // count), 1)
    for k in range(0, len(ordered), size):
        part = ordered[k : k + size]
        yield part, spans[part[0].index][0], max(spans[hold.index][1] for hold in part)


def _find_arrivals(times: SensorTimes, stamps: Array) -> Array:
    """When the messages of some stamps (N,) arrived, s; the first one of several with the same stamp."""
    found: Array = times.arrivals[np.searchsorted(times.stamps, stamps)]
    return found
