"""What a session had captured before it was interrupted, from its recording."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from calgraph.boards.detections import DetectionResult
from calgraph.config import Rig
from calgraph.errors import CalibrationError, Rejected
from calgraph.live.analysis_jobs import NO_INTRINSICS
from calgraph.live.live_captures import LiveCapture
from calgraph.parallel.engine import Engine
from calgraph.recording import Recording, resolve_intrinsics
from calgraph.rig.captures.detect import limit_messages
from calgraph.rig.captures.holds import Hold, find_holds
from calgraph.rig.captures.sensor_detection import DetectionMethod, detect_by_sensors
from calgraph.rig.captures.timeline import RecordingTimeline, build_timeline
from calgraph.sensors import CameraModel


@dataclass(frozen=True, eq=False)
class RebuiltSession:
    """The captures of a recording, and when its sensors measured."""

    timeline: RecordingTimeline
    cameras: Mapping[str, CameraModel]
    """Intrinsics by camera, as far as the recording has any."""
    captures: tuple[LiveCapture, ...] = field(default=())


def rebuild_captures(rig: Rig, recording: Recording, seeds: Mapping[str, int], engine: Engine) -> RebuiltSession:
    """The captures of the recording of an interrupted session; sensors may be missing in it.

    Args:
        rig: of the session; see :func:`calgraph.live.live_rig.prepare_live_rig`.
        recording: until the interruption.
        seeds: of the detectors' samples, by sensor; see :func:`calgraph.rig.captures.detectors.draw_seeds`.
        engine: searches the board.

    Raises:
        RecordingError: it cannot be read.
    """
    present = {topic.name for topic in recording.topics}
    recorded = {name: spec for name, spec in rig.sensors.items() if spec.topic in present}
    part = rig.model_copy(update={"sensors": recorded})
    cameras = resolve_intrinsics(part, recording).camera_models()
    wanted = [topic for topic in (*part.topics.values(), rig.capture.trigger) if topic in present]
    records = recording.records([topic for topic in wanted if topic])
    timeline = build_timeline(records, recording.start, rig.topics, rig.capture.trigger)
    try:
        holds = limit_messages(find_holds(timeline, rig.capture, rig.settings.captures), rig)
    except CalibrationError:  # none yet
        return RebuiltSession(timeline, cameras)
    detecting = {name: spec for name, spec in recorded.items() if spec.kind != "camera" or name in cameras}
    found = detect_by_sensors(
        part.model_copy(update={"sensors": detecting}),
        recording,
        timeline,
        holds,
        DetectionMethod(cameras, seeds),
        engine=engine,
    )
    by_hold: dict[int, dict[str, DetectionResult]] = {hold.index: {} for hold in holds}
    for one in found:
        by_hold[one.capture][one.sensor] = one.detections
    return RebuiltSession(
        timeline, cameras, tuple(_make_capture(rig, hold, by_hold[hold.index]) for hold in holds)
    )


def _make_capture(rig: Rig, hold: Hold, found: Mapping[str, DetectionResult]) -> LiveCapture:
    """A capture with all sensors of the rig in its order."""
    return LiveCapture(hold, {name: found.get(name, Rejected(NO_INTRINSICS)) for name in rig.sensors})
