"""Records of live messages, as a recording of these messages has them."""

from rosbags.interfaces import MessageDefinitionFormat

from calgraph.config.settings import LimitSettings
from calgraph.live.source import Channel, LiveMessage
from calgraph.recording.message_types import MessageType, TypeDefinition, make_message_type
from calgraph.recording.record_list import make_record
from calgraph.sensors import RecordedMessage

_FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros1msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
}


class RecordReader:
    """Makes records of live messages: stamps are read immediately, contents are decoded on demand.

    Args:
        source: name of the source, for error messages.
        limits: of the content of messages.
    """

    def __init__(self, source: str, limits: LimitSettings) -> None:
        self._source, self._limits = source, limits
        self._types: dict[Channel, MessageType] = {}

    def read(self, message: LiveMessage) -> RecordedMessage:
        """The record of a message; its stamp is the arrival where it has no header.

        Raises:
            RecordingError: its header cannot be read.
        """
        channel = message.channel
        if channel not in self._types:
            self._types[channel] = make_message_type(
                TypeDefinition(channel.type, _FORMATS[channel.schema_format], channel.schema, channel.encoding)
            )
        return make_record(
            self._types[channel], channel.topic, message.arrival / 1e9, message.data, self._source, self._limits
        )
