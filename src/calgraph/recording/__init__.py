"""Recordings in and out, as streams of messages: ROS bags and plain folders."""

from calgraph.recording.cameras import read_cameras
from calgraph.recording.opening import open_recording, open_recordings
from calgraph.recording.recording import Recording, TopicInfo
from calgraph.recording.writer import Encoding, RecordingWriter

__all__ = [
    "Encoding", "Recording", "RecordingWriter", "TopicInfo", "open_recording", "open_recordings", "read_cameras"
]  # fmt: skip
