"""When the sensors of a rig measured, and how much their views changed."""

from dataclasses import replace

from calgraph.config import Rig
from calgraph.parallel.progress import Progress
from calgraph.recording import PoseRecordings, Recording
from calgraph.recording.input_checks import InputMonitor
from calgraph.rig.captures.capture_mode import recognize_mode
from calgraph.rig.captures.timeline import RecordingTimeline
from calgraph.rig.captures.timeline_reading import measure_activity, read_timeline
from calgraph.rig.options import RigOptions


def read_rig_timeline(
    rig: Rig, recording: Recording, monitor: InputMonitor, options: RigOptions, progress: Progress
) -> RecordingTimeline:
    """The stamps of every sensor's messages and, where it matters, how much its view changed at each."""

    def reading(arrival: float) -> None:
        progress("reading", (arrival - recording.start) / max(recording.end - recording.start, 1e-9))

    timeline = read_timeline(rig, recording, monitor, options.cache, reading)
    if isinstance(recording, PoseRecordings):
        timeline = replace(timeline, poses=recording.poses)
    if rig.capture.trigger or recognize_mode(timeline, rig.capture, rig.settings.captures).mode == "snapshots":
        return timeline
    return measure_activity(timeline, rig, recording, options.cache, reading, options.engine)
