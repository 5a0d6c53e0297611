"""Recordings in and out, as streams of messages: ROS bags and plain folders."""

from calgraph.recording.flat import scan_of_cloud
from calgraph.recording.opening import open_recording, open_recordings
from calgraph.recording.recording import Recording, TopicInfo
from calgraph.recording.writer import Encoding, RecordingWriter

__all__ = [
    "Encoding", "Recording", "RecordingWriter", "TopicInfo", "open_recording", "open_recordings", "scan_of_cloud",
]  # fmt: skip
