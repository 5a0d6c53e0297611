"""Messages in memory, read like a recording."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from calgraph.errors import InputError
from calgraph.recording.record_list import IndexedRecording
from calgraph.sensors import CameraInfo, Image, LaserScan, Message, PointCloud, RecordedMessage, Trigger

_TYPES = {Image: "image", LaserScan: "scan", PointCloud: "cloud", CameraInfo: "camera_info", Trigger: "trigger"}


class MessageRecording(IndexedRecording):
    """Messages by topic as a recording, for scans, clouds and images that are arrays already.

    Args:
        messages: by topic, in any order; they arrive at their stamps.

    Raises:
        InputError: there are none.
    """

    def __init__(self, messages: Mapping[str, Sequence[Message]]) -> None:
        listed = [_record(topic, message) for topic, sent in messages.items() for message in sent]
        if not listed:
            raise InputError("no messages are given; a recording needs one at least")
        types = {topic: _TYPES[type(sent[0])] for topic, sent in messages.items() if sent}
        super().__init__(Path("messages"), listed, types)


def _record(topic: str, message: Message) -> RecordedMessage:
    return RecordedMessage(topic, message.stamp, message.stamp, lambda: message)
