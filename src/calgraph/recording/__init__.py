"""Recordings in and out, as streams of messages: ROS bags and plain folders."""

from calgraph.recording.cache import NO_CACHE, RecordingCache
from calgraph.recording.camera_info import find_camera_infos, list_camera_info_topics, resolve_intrinsics
from calgraph.recording.converted_images import convert_images
from calgraph.recording.inspection import Inspection, Timing, TopicReport, find_topics, inspect_recording
from calgraph.recording.opening import RecordingReference, open_recording, open_recordings, refer_to
from calgraph.recording.record_list import MessageRecording
from calgraph.recording.recording import Recording, TopicInfo
from calgraph.recording.takes import ClockCorrectedRecording, PoseRecordings, correct_stamps, separate_poses
from calgraph.recording.writer import Encoding, RecordingWriter

__all__ = [
    "NO_CACHE", "ClockCorrectedRecording", "Encoding", "Inspection", "MessageRecording",
    "PoseRecordings", "Recording", "RecordingCache", "RecordingReference", "RecordingWriter",
    "Timing", "TopicInfo", "TopicReport",
    "convert_images", "correct_stamps", "find_camera_infos", "find_topics", "inspect_recording",
    "list_camera_info_topics",
    "open_recording", "open_recordings", "refer_to", "resolve_intrinsics", "separate_poses",
]  # fmt: skip
