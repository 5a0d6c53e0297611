"""Records of serialised ROS messages, from bags and from live sources."""

from functools import partial
from typing import NamedTuple

from calgraph.config.settings import LimitSettings
from calgraph.recording.damage import wrap_errors
from calgraph.recording.decoding import decode
from calgraph.recording.message_types import MessageType
from calgraph.sensors import RecordedMessage


class _Place(NamedTuple):
    """Where a message is; as text, which takes longer to make than all else of a record, in errors only."""

    source: object
    topic: str
    time: str
    """Which time is known of it."""
    value: float
    """s."""

    def __str__(self) -> str:
        return f"{self.source}: topic {self.topic}, {self.time} {self.value:.6f}"


def make_record(
    kind: MessageType, topic: str, arrival: float, raw: bytes, source: object, limits: LimitSettings
) -> RecordedMessage:
    """The record of a message, whose content is decoded on demand.

    Args:
        kind: the message's type.
        topic: its topic.
        arrival: when it arrived, s.
        raw: its serialised bytes.
        source: the file or address that it comes from, for error messages; it is pickled with the record.
        limits: of its content.

    Raises:
        RecordingError: its header cannot be read.
    """
    try:
        header_stamp = kind.header_stamp(raw)
    except Exception:
        with wrap_errors(_Place(source, topic, "arrival", arrival)):
            raise
    stamp = arrival if header_stamp is None else header_stamp / 1e9
    place = _Place(source, topic, "stamp", stamp)
    return RecordedMessage(
        topic, stamp, arrival, partial(decode, kind, raw, stamp, place, limits), partial(kind.digest, raw)
    )
