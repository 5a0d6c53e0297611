"""How a recording shows the board, found without a rig.yaml: for a first draft of one, and for inspection."""

from collections.abc import Collection

from calgraph.config import Capture
from calgraph.config.settings import CaptureSettings
from calgraph.errors import RecordingError
from calgraph.recording import Recording
from calgraph.rig.captures.capture_mode import RecognizedMode, recognize_mode
from calgraph.rig.captures.motion_detection import ActivityMeter
from calgraph.rig.captures.timeline import build_timeline

# Only a draft depends on these. Stamps are read from this much of a large recording, s: ten poses of snapshots.
_STAMPS_DURATION = 300.0
# Smaller recordings are read whole, which takes less than a second.
_MAX_MESSAGES = 20_000
# Messages are decoded from this much of it, s: several moves and rests of a board that is carried around.
_ACTIVITY_DURATION = 20.0


def recognize_recording(
    recording: Recording, topics: Collection[str], settings: CaptureSettings, empty_end: float = 0.0
) -> RecognizedMode | None:
    """Recognises how a recording without triggers shows the board.

    Messages are decoded only if the stamps of several sensors show sets of frames: these are of a moving board
    unless it rests in between.

    Args:
        recording: to be read.
        topics: of its sensors, with usable messages.
        settings: of the search for captures.
        empty_end: end of the time without board at the start, s.

    Returns:
        The mode; None for fewer than two sensors, or if a message is damaged, which reading all of them reports.
    """
    if len(topics) < 2:
        return None
    try:
        return _recognize(recording, topics, empty_end, settings)
    except RecordingError:
        return None


def _recognize(
    recording: Recording, topics: Collection[str], empty_end: float, settings: CaptureSettings
) -> RecognizedMode:
    names = {topic: topic for topic in topics}
    start = recording.start
    is_small = sum(topic.count for topic in recording.topics) <= _MAX_MESSAGES
    records = recording.records(topics, start, recording.end if is_small else start + _STAMPS_DURATION)
    mode = recognize_mode(build_timeline(records, start, names, None), Capture(), settings)
    if mode.mode == "snapshots" or mode.spread is None:
        return mode
    begin = start + empty_end
    meters = {topic: ActivityMeter() for topic in topics}
    records = recording.records(topics, begin, begin + _ACTIVITY_DURATION)
    return recognize_mode(build_timeline(records, start, names, None, meters=meters), Capture(), settings)
