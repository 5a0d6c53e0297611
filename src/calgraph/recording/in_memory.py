"""Messages in memory, read like a recording."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from calgraph.errors import InputError
from calgraph.recording.content_hash import hash_array
from calgraph.recording.record_list import IndexedRecording
from calgraph.sensors import CameraInfo, Message, MessageDigest, RecordedMessage, Trigger


class MessageRecording(IndexedRecording):
    """Messages by topic as a recording, for scans, clouds and images that are arrays already.

    Args:
        messages: by topic, in any order; they arrive at their stamps.

    Raises:
        InputError: there are none.
    """

    def __init__(self, messages: Mapping[str, Sequence[Message]]) -> None:
        listed = [record_message(topic, message) for topic, sent in messages.items() for message in sent]
        if not listed:
            raise InputError("no messages are given; a recording needs one at least")
        types = {topic: sent[0].topic_type for topic, sent in messages.items() if sent}
        super().__init__(Path("messages"), listed, types)


def record_message(topic: str, message: Message) -> RecordedMessage:
    """The record of a message, which arrives at its stamp."""
    return RecordedMessage(topic, message.stamp, message.stamp, partial(_get, message), partial(_digest, message))


def _get(message: Message) -> Message:
    """The message: unlike a local function, a partial of this one can be pickled."""
    return message


def _digest(message: Message) -> MessageDigest:
    if isinstance(message, CameraInfo):
        camera = message.camera
        content = hash(
            (camera.model, camera.width, camera.height, hash_array(camera.K), hash_array(camera.distortion))
        )
        return MessageDigest(message.frame_id, content)
    if isinstance(message, Trigger):
        return MessageDigest("", hash_array(np.zeros(0)))
    return MessageDigest(message.frame_id, hash_array(getattr(message, message.measured)))
