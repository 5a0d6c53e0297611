"""When the board rests, which messages were measured then, and what is found in them."""

from calgraph.captures.detect import Captured, Detect, Observation, gather, observe, thinned
from calgraph.captures.detectors import as_scans, detectors, learn_backgrounds
from calgraph.captures.from_detections import Found, captured_from
from calgraph.captures.holds import Hold, find_holds, is_snapshots
from calgraph.captures.motion_detection import ActivityMeter
from calgraph.captures.previews import Detail, details
from calgraph.captures.timeline import SensorTimes, Timeline, survey
from calgraph.captures.validate_recording import check_timeline

__all__ = [
    "ActivityMeter", "Captured", "Detail", "Detect", "Found", "Hold", "Observation", "SensorTimes", "Timeline",
    "as_scans", "captured_from", "check_timeline", "details", "detectors", "find_holds", "gather", "is_snapshots",
    "learn_backgrounds", "observe", "survey", "thinned",
]  # fmt: skip
