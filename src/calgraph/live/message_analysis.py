"""Messages of a live session: kept for a while, and analysed in other processes as far as these keep up."""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

from calgraph.config import CameraSpec, Rig
from calgraph.errors import CalgraphError, Rejected
from calgraph.live.analysis_jobs import MeasuredChanges, learn_live_background, measure_changes
from calgraph.live.capture_finder import MAX_RATE
from calgraph.live.job_queue import JobQueue
from calgraph.live.live_detectors import LiveDetectors
from calgraph.live.live_timeline import LiveTimeline
from calgraph.live.message_ring import MessageRing
from calgraph.live.motion import RestMonitor
from calgraph.live.record_reader import RecordReader
from calgraph.live.sensor_activity import SensorActivity
from calgraph.live.source import LiveMessage
from calgraph.live.view_pictures import SensorView, make_view
from calgraph.recording.takes import shift_record
from calgraph.rig.captures.detectors import Background
from calgraph.rig.captures.stillness import MAX_MOTION_PERIOD
from calgraph.rig.captures.timeline import RecordingTimeline
from calgraph.sensors import CameraModel, RecordedMessage

_log = logging.getLogger(__name__)

# Messages whose change one call measures: some 0.1 s of work, so that captures and pictures come in between.
_MESSAGES_PER_CALL = 8


# Maximum number of messages of a sensor that wait for it: 2 s; older ones are skipped, and the next is compared
# with the last one measured.
_MAX_WAITING = 20


class MessageAnalysis:
    """What the messages of a rig show while they arrive.

    Args:
        rig: of the session.
        source: name of the source, for error messages.
        changed: called when something is to be shown.
    """

    def __init__(self, rig: Rig, source: str, changed: Callable[[], None]) -> None:
        self._rig, self._changed = rig, changed
        self._reader = RecordReader(source, rig.settings.limits)
        self._sensor_of = {topic: name for name, topic in rig.topics.items()}
        # Offsets that are to be estimated are known when the recording is calibrated.
        offsets = {name: spec.clock_offset for name, spec in rig.sensors.items()}
        self._clock_offsets = {name: o if isinstance(o, float) else 0.0 for name, o in offsets.items()}
        self._learning: set[str] = set()
        self.timeline = LiveTimeline(rig.sensors)
        self.ring = MessageRing(rig.settings.live.ring)
        self.rests = RestMonitor(rig.sensors)
        self.detectors = LiveDetectors(rig)
        self.sensors = {name: SensorActivity(rig.settings.live.view) for name in rig.sensors}
        self._last_queued: dict[str, float] = {}

    @property
    def background_left(self) -> float:
        """Time until the views need no longer be free of board and operator, s; 0 afterwards."""
        window = self._rig.capture.background
        if window is None:
            return 0.0
        begin = self.timeline.start
        return window[1] if begin is None else max(begin + window[1] - self.timeline.latest_arrival, 0.0)

    @property
    def lag(self) -> float:
        """Time by which motion and rooms that other processes compute are behind the messages, s."""
        oldest = (sensor.oldest_unmeasured for sensor in self.sensors.values())
        due = [arrival for arrival in oldest if arrival is not None]
        window, begin = self._rig.capture.background, self.timeline.start
        if window and begin is not None and not all(map(self.detectors.is_ready, self._learning)):
            due.append(begin + window[1])
        return max(self.timeline.latest_arrival - min(due), 0.0) if due else 0.0

    def restore(
        self,
        timeline: RecordingTimeline,
        end: float,
        cameras: Mapping[str, CameraModel],
        background: Iterable[RecordedMessage],
    ) -> None:
        """Continues after what was recorded before.

        Args:
            timeline: of the recording.
            end: arrival of its last message, s.
            cameras: intrinsics by camera, as far as it has any.
            background: the sensors' messages in its background window: scanners learn the room from them, and the
                noise of all at rest is measured again.
        """
        self.timeline.restore(timeline, end)
        self.detectors.restore(cameras)
        for record in background:
            self._queue(self._sensor_of[record.topic], record)

    def feed(self, message: LiveMessage) -> None:
        """Takes a message; those that are unusable are counted."""
        topic = message.channel.topic
        name = self._sensor_of.get(topic)
        self.timeline.note_arrival(message.arrival / 1e9)
        if name is None and topic not in self.detectors.intrinsics_topics:
            return
        try:
            record = self._reader.read(message)
            if name is None:
                self.detectors.add_intrinsics(record)
                return
            record = shift_record(record, -self._clock_offsets[name], 0.0)
            self.ring.add(name, record, len(message.data))
            self._queue(name, record)
            self.timeline.add(name, record)
        except CalgraphError as error:
            self._note_malformed(topic, name, error)

    def _note_malformed(self, topic: str, name: str | None, error: CalgraphError) -> None:
        names = [name] if name else self.detectors.cameras_of(topic)
        for one in names:
            self.sensors[one].note_malformed(str(error))
        self._changed()

    def _queue(self, name: str, record: RecordedMessage) -> None:
        """Has a message analysed: drawn, measured, and the room learned from it."""
        sensor = self.sensors[name]
        sensor.latest = record
        if self._is_of_background(record) and not isinstance(self._rig.sensors[name], CameraSpec):
            self._keep_background(name, record)
        slow = self.timeline.period(name) > MAX_MOTION_PERIOD
        if slow and len(self.timeline.stamps_from(name, 0.0)) > 1:
            return
        # Periods vary by some percent: of a sensor at the highest rate every message is measured.
        if abs(record.stamp - self._last_queued.get(name, float("-inf"))) > 0.9 / MAX_RATE:
            self._last_queued[name] = record.stamp
            sensor.waiting.append(record)
            while len(sensor.waiting) > _MAX_WAITING:
                sensor.waiting.popleft()

    def _keep_background(self, name: str, record: RecordedMessage) -> None:
        """Keeps a message that a scanner learns the room from, if it needs more."""
        kept = self.sensors[name].background
        if len(kept) < self._rig.settings.captures.max_background_messages:
            kept.append(record)

    def _is_of_background(self, record: RecordedMessage) -> bool:
        window, begin = self._rig.capture.background, self.timeline.start
        if window is None or begin is None:
            return False
        return begin + window[0] <= record.arrival <= begin + window[1]

    def start_job(self, queue: JobQueue) -> bool:
        """Starts what is most urgent of what is to be computed; whether there was anything."""
        return self._learn_background(queue) or self._measure_changes(queue) or self._draw(queue)

    def _learn_background(self, queue: JobQueue) -> bool:
        window, begin = self._rig.capture.background, self.timeline.start
        if window is None or begin is None or self.timeline.latest_arrival <= begin + window[1]:
            return False
        for name, spec in self._rig.sensors.items():
            if isinstance(spec, CameraSpec) or name in self._learning or self.detectors.is_ready(name):
                continue
            self._learning.add(name)
            decoders = [record.decode for record in self.sensors[name].background]
            self.sensors[name].background = []
            queue.run(
                learn_live_background, self._rig, name, decoders,
                done=partial(self._set_background, name),
                failed=partial(self._fail_learning, name),
            )  # fmt: skip
            return True
        return False

    def _fail_learning(self, name: str, error: BaseException) -> None:
        self._set_background(name, Rejected(str(error)))

    def _set_background(self, name: str, background: Background | Rejected) -> None:
        if isinstance(background, Rejected):
            _log.warning("%s: %s; it detects the board by size and shape", name, background.reason)
        self.detectors.set_background(name, background)
        self._changed()

    def _measure_changes(self, queue: JobQueue) -> bool:
        waiting = [name for name, sensor in self.sensors.items() if sensor.waiting and not sensor.measuring]
        if not waiting:
            return False
        name = min(waiting, key=lambda one: self.sensors[one].waiting[0].arrival)
        sensor = self.sensors[name]
        records = [sensor.waiting.popleft() for _ in range(min(len(sensor.waiting), _MESSAGES_PER_CALL))]
        sensor.measuring = records
        queue.run(
            measure_changes, self.rests.previous(name),
            [record.decode for record in records],
            done=partial(self._add_changes, name, records),
            failed=partial(self._fail_measuring, name),
        )  # fmt: skip
        return True

    def _add_changes(self, name: str, records: Sequence[RecordedMessage], measured: MeasuredChanges) -> None:
        sensor = self.sensors[name]
        sensor.measuring = ()
        for change in measured.changes:
            if change is None:
                sensor.note_malformed(measured.problem)
        usable = [
            (record.stamp, change)
            for record, change in zip(records, measured.changes, strict=True)
            if change is not None
        ]
        was_moving = self.rests.is_moving(name)
        quiet = all(self._is_of_background(record) for record in records)
        self.rests.add(name, [s for s, _ in usable], [c for _, c in usable], measured.last, quiet=quiet)
        if self.rests.is_moving(name) != was_moving:
            self._changed()

    def _fail_measuring(self, name: str, error: BaseException) -> None:
        self.sensors[name].measuring = ()
        self.sensors[name].note_malformed(str(error))

    def _draw(self, queue: JobQueue) -> bool:
        settings = self._rig.settings.live.view
        due = [
            name
            for name, sensor in self.sensors.items()
            if sensor.latest
            and not sensor.drawing
            and sensor.latest.arrival - sensor.drawn_at >= 1 / settings.rate
        ]
        if not due:
            return False
        name = min(due, key=lambda one: self.sensors[one].drawn_at)
        sensor = self.sensors[name]
        record, sensor.latest, sensor.drawing = sensor.latest, None, True
        assert record is not None
        sensor.drawn_at = record.arrival
        encoded = self.detectors.encode(name, reduced=True) if self.detectors.is_ready(name) else None
        queue.run(
            make_view, record.decode, encoded,
            self.detectors.reduced_camera(name), self._rig.boards, self.detectors.reduction(name), settings,
            done=partial(self._set_view, name),
            failed=lambda error: self._set_view(name, SensorView(b"", None, str(error))),
        )  # fmt: skip
        return True

    def _set_view(self, name: str, view: SensorView) -> None:
        self.sensors[name].drawing = False
        self.sensors[name].set_view(view)
        self._changed()
