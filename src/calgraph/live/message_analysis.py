"""Messages of a live session: kept for a while, and analysed in other processes as far as these keep up."""

import logging
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from uuid import uuid4

import numpy as np

from calgraph.config import CameraSpec, Rig
from calgraph.errors import CalgraphError, Rejected
from calgraph.live.analysis_jobs import DetectorInputs, learn_live_background, measure_changes, reduce_camera
from calgraph.live.capture_finder import MAX_RATE
from calgraph.live.job_queue import JobQueue
from calgraph.live.live_captures import explain_rejection
from calgraph.live.live_rig import list_intrinsics_topics
from calgraph.live.live_timeline import LiveTimeline
from calgraph.live.message_ring import MessageRing
from calgraph.live.motion import RestMonitor
from calgraph.live.source import LiveMessage
from calgraph.live.view_pictures import SensorView, find_reduction, make_view
from calgraph.rig.captures.detectors import draw_seeds
from calgraph.rig.captures.motion_detection import Signed
from calgraph.rig.captures.timeline import MAX_MOTION_PERIOD
from calgraph.rig.kinds.rig_kind import Background
from calgraph.rig.options import RigOptions
from calgraph.sensors import CameraInfo, CameraModel, RecordedMessage
from calgraph.sensors.kinds import KINDS

_log = logging.getLogger(__name__)

# Messages whose change one call measures: some 0.1 s of work, so that captures and pictures come in between.
_MESSAGES_PER_CALL = 8


# Maximum number of pictures of a sensor per second: operators see motion, and processes are free for captures.
_PICTURE_RATE = 3.0
# Maximum number of messages of a sensor that wait for it: 2 s; older ones are skipped, and the next is compared
# with the last one measured.
_MAX_WAITING = 20


class MessageAnalysis:
    """What the messages of a rig show while they arrive.

    Args:
        rig: of the session.
        source: name of the source, for error messages.
    """

    def __init__(self, rig: Rig, source: str) -> None:
        self._rig, self._source = rig, source
        self._sensor_of = {topic: name for name, topic in rig.topics.items()}
        self._learning: set[str] = set()
        self.timeline = LiveTimeline(rig)
        self.ring = MessageRing(rig.settings.live.ring)
        self.rests = RestMonitor(rig.sensors)
        self.detectors = LiveDetectors(rig)
        self.sensors = {name: SensorActivity() for name in rig.sensors}
        self._last_queued: dict[str, float] = {}

    @property
    def _background(self) -> tuple[float, float]:
        """Arrivals between which the views must be free of board and operator, s."""
        begin, window = self.timeline.start or 0.0, self._rig.capture.background or (0.0, 0.0)
        return begin + window[0], begin + window[1]

    @property
    def background_left(self) -> float:
        """Time until the views need no longer be free of board and operator, s; 0 afterwards."""
        return max(self._background[1] - self.timeline.latest_arrival, 0.0)

    @property
    def lag(self) -> float:
        """Time by which motion and rooms that other processes compute are behind the messages, s."""
        oldest = (sensor.oldest_unmeasured for sensor in self.sensors.values())
        due = [arrival for arrival in oldest if arrival is not None]
        if not all(map(self.detectors.is_ready, self._learning)):
            due.append(self._background[1])
        return max(self.timeline.latest_arrival - min(due), 0.0) if due else 0.0

    def feed(self, message: LiveMessage, *, is_past: bool = False) -> None:
        """Takes a message; those that are unusable are counted.

        Args:
            message: that has been recorded.
            is_past: whether it was before the session was interrupted. Then it is analysed only if it is of the
                background window: scanners learn the room from it, and it shows the noise at rest.
        """
        topic = message.channel.topic
        name = self._sensor_of.get(topic)
        self.timeline.note_arrival(message.arrival / 1e9)
        if name is None and topic not in self.detectors.intrinsics_topics:
            return
        try:
            record = message.read(self._source, self._rig.settings.limits)
            if name is None:
                self.detectors.add_intrinsics(record)
                return
            record = self.timeline.correct(name, record)
            if not is_past:
                self.ring.add(name, record, len(message.data))
            if not is_past or self._is_of_background(record):
                self._queue(name, record)
            self.timeline.add(name, record)
        except CalgraphError as error:
            for one in [name] if name else self.detectors.cameras_of(topic):
                self.timeline.sensors[one].note_malformed(str(error))

    def _queue(self, name: str, record: RecordedMessage) -> None:
        """Has a message analysed: drawn, measured, and the room learned from it."""
        sensor = self.sensors[name]
        sensor.latest = record
        has_enough = len(sensor.background) >= self._rig.settings.captures.max_background_messages
        if (
            KINDS[self._rig.sensors[name].kind].measures_ranges
            and self._is_of_background(record)
            and not has_enough
        ):
            sensor.background.append(record)
        slow = self.timeline.sensors[name].period > MAX_MOTION_PERIOD
        if slow and len(self.timeline.sensors[name].stamps) > 1:
            return
        # Periods vary by some percent: of a sensor at the highest rate every message is measured.
        if abs(record.stamp - self._last_queued.get(name, float("-inf"))) > 0.9 / MAX_RATE:
            self._last_queued[name] = record.stamp
            sensor.waiting.append(record)
            while len(sensor.waiting) > _MAX_WAITING:
                sensor.waiting.popleft()

    def _is_of_background(self, record: RecordedMessage) -> bool:
        begin, end = self._background
        return begin <= record.arrival <= end

    def start_job(self, queue: JobQueue) -> bool:
        """Starts what is most urgent of what is to be computed; whether there was anything."""
        return self._learn_background(queue) or self._measure_changes(queue) or self._draw(queue)

    def _learn_background(self, queue: JobQueue) -> bool:
        if self.timeline.latest_arrival <= self._background[1]:
            return False
        for name, spec in self._rig.sensors.items():
            if isinstance(spec, CameraSpec) or name in self._learning or self.detectors.is_ready(name):
                continue
            self._learning.add(name)
            decoders = [record.decode for record in self.sensors[name].background]
            self.sensors[name].background = []
            queue.run(partial(self._set_background, name), learn_live_background, self._rig, name, decoders)
            return True
        return False

    def _set_background(self, name: str, background: Background | Rejected) -> None:
        if isinstance(background, Rejected):
            _log.warning("%s: %s; it detects the board by size and shape", name, background.reason)
        self.detectors.set_background(name, background)

    def _measure_changes(self, queue: JobQueue) -> bool:
        waiting = [name for name, sensor in self.sensors.items() if sensor.waiting and not sensor.measuring]
        if not waiting:
            return False
        name = min(waiting, key=lambda one: self.sensors[one].waiting[0].arrival)
        sensor = self.sensors[name]
        records = [sensor.waiting.popleft() for _ in range(min(len(sensor.waiting), _MESSAGES_PER_CALL))]
        sensor.measuring = records
        decoders = [record.decode for record in records]
        queue.run(partial(self._add_changes, name, records), measure_changes, self.rests.previous(name), decoders)
        return True

    def _add_changes(
        self,
        name: str,
        records: Sequence[RecordedMessage],
        measured: tuple[Sequence[float | Rejected], Signed | None] | Rejected,
    ) -> None:
        self.sensors[name].measuring = ()
        changes, last = ([measured], None) if isinstance(measured, Rejected) else measured
        for change in changes:
            if isinstance(change, Rejected):
                self.timeline.sensors[name].note_malformed(change.reason)
        if isinstance(measured, Rejected):
            return
        usable = [
            (record.stamp, change)
            for record, change in zip(records, changes, strict=True)
            if not isinstance(change, Rejected)
        ]
        quiet = all(self._is_of_background(record) for record in records)
        self.rests.add(name, [s for s, _ in usable], [c for _, c in usable], last, quiet=quiet)

    def _draw(self, queue: JobQueue) -> bool:
        due = [
            name
            for name, sensor in self.sensors.items()
            if sensor.latest
            and not sensor.drawing
            and sensor.latest.arrival - sensor.drawn_at >= 1 / _PICTURE_RATE
        ]
        if not due:
            return False
        name = min(due, key=lambda one: self.sensors[one].drawn_at)
        sensor = self.sensors[name]
        record, sensor.latest, sensor.drawing = sensor.latest, None, True
        assert record is not None
        sensor.drawn_at = record.arrival
        factor = self.detectors.reduction(name)
        inputs = self.detectors.state_inputs(name, factor)
        queue.run(
            sensor.set_view, make_view, record.decode,
            inputs if self.detectors.is_ready(name) else None, inputs.camera, self._rig.boards, factor,
        )  # fmt: skip
        return True


class LiveDetectors:
    """Intrinsics and backgrounds that have been found so far, and the detectors made from them."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        # As calibrate_rig draws them first of all.
        self.seeds = draw_seeds(rig, np.random.default_rng(RigOptions().seed))
        """Of the detectors' samples, by sensor."""
        self._stated = rig.camera_models()
        self._infos: dict[str, CameraModel | None] = {}
        """By topic, the intrinsics of its first message; None if it has none."""
        self._backgrounds: dict[str, Background | Rejected] = {}
        self._topics = list_intrinsics_topics(rig)
        self._session, self._changes = uuid4().hex, 0
        """Which detectors these are, of all in this process, and how often their inputs have changed."""

    @property
    def cameras(self) -> dict[str, CameraModel]:
        """Intrinsics by camera, as far as they are known."""
        found = ((name, self._infos.get(topic)) for name, topics in self._topics.items() for topic in topics[::-1])
        return self._stated | {name: camera for name, camera in found if camera}

    @property
    def intrinsics_topics(self) -> frozenset[str]:
        """Topics that may have intrinsics."""
        return frozenset(topic for topics in self._topics.values() for topic in topics)

    def add_intrinsics(self, record: RecordedMessage) -> None:
        """Takes the intrinsics of a message, for the cameras that its topic is of; the first message counts.

        Raises:
            RecordingError: its content is unusable.
        """
        if record.topic in self._infos:
            return
        self._infos[record.topic] = None
        message = record.decode()
        if isinstance(message, CameraInfo):
            self._infos[record.topic] = message.camera
            self._changes += 1

    def cameras_of(self, topic: str) -> list[str]:
        """The cameras whose intrinsics a topic may have."""
        return [name for name, topics in self._topics.items() if topic in topics]

    def set_background(self, name: str, background: Background | Rejected) -> None:
        """Takes what a scanner has learned, or why it has not."""
        self._backgrounds[name] = background
        self._changes += 1

    def is_ready(self, name: str) -> bool:
        """Whether messages of a sensor can be searched: scanners learn the room first."""
        return not KINDS[self._rig.sensors[name].kind].measures_ranges or name in self._backgrounds

    def reduction(self, name: str) -> int:
        """The factor by which images of a camera are reduced for pictures; 1 of scanners."""
        camera = self.cameras.get(name)
        return find_reduction(camera) if camera else 1

    def state_inputs(self, name: str, factor: int = 1) -> DetectorInputs:
        """What the detector of a sensor is made from, for images of a camera that are reduced by a factor."""
        camera, background = self.cameras.get(name), self._backgrounds.get(name)
        return DetectorInputs(
            name,
            (self._session, self._changes, factor),
            self._rig.model_copy(update={"sensors": {name: self._rig.sensors[name]}}),
            reduce_camera(camera, factor) if camera else None,
            None if isinstance(background, Rejected) else background,
            self.seeds,
        )


# Number of images that this median is of: 20 s.
_SHARPNESS_IMAGES = 60
# Sharpness of an image over its median of late, below which it is blurred: rest and small boards change it by
# less.
_SHARPNESS_RATIO = 0.5


@dataclass
class SensorActivity:
    """The messages of one sensor that wait for other processes, and its last view."""

    waiting: deque[RecordedMessage] = field(default_factory=deque)
    """Messages whose change is to be measured."""
    measuring: Sequence[RecordedMessage] = ()
    """Messages whose change is being measured."""
    background: list[RecordedMessage] = field(default_factory=list)
    """Of a scanner, the messages that it learns the room from."""
    latest: RecordedMessage | None = None
    """The last message that has not been drawn."""
    drawing: bool = False
    drawn_at: float = float("-inf")
    """Arrival of the message that was drawn last, s."""
    view: SensorView | None = None
    pictures: int = 0
    sharpness: deque[float] = field(default_factory=lambda: deque(maxlen=_SHARPNESS_IMAGES))

    @property
    def oldest_unmeasured(self) -> float | None:
        """Arrival of the first message whose change is not known yet, s; None if there is none."""
        return next((record.arrival for record in (*self.measuring, *self.waiting)), None)

    def set_view(self, view: SensorView | Rejected) -> None:
        """Takes a new picture, or why the message is unusable."""
        self.drawing = False
        self.view = SensorView(b"", None, view.reason) if isinstance(view, Rejected) else view
        if self.view.picture:
            self.pictures += 1
            self.sharpness.append(self.view.sharpness)

    def explain_view(self) -> str:
        """Why the sensor does not detect the board now; empty if it does, or if that is not known."""
        if self.view is None or self.view.sees_board is not False:
            return ""
        # Compared with the images of late.
        is_blurred = self.sharpness[-1] < _SHARPNESS_RATIO * float(np.median(list(self.sharpness)))
        return "blurred" if is_blurred else explain_rejection(self.view.reason)
