"""Videos as messages: packets of H.264 or H.265, each of one frame, which is decoded from its keyframe on.

Foxglove's CompressedVideo, and ffmpeg_image_transport's FFMPEGPacket. Both are made for streams, whose frames are
in the order in which they are shown.
"""

import re
import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING

from calgraph.config.settings import LimitSettings
from calgraph.recording.damage import wrap_errors
from calgraph.recording.images import Pixels
from calgraph.recording.message_types import MessageType, clean_frame_id
from calgraph.recording.video import Frame, import_av, to_pixels
from calgraph.sensors import Message
from calgraph.sensors.kinds.camera import VIDEO_TYPES

if TYPE_CHECKING:
    from av import VideoCodecContext, VideoFrame

KEYFRAME_TIME = 10.0
"""Time before a message within which its keyframe is, s: encoders send one every 250 frames or more often."""
# Codecs by what messages call them: h264, libx264, h264_nvenc, hevc, H265, ...
_CODECS = {"264": "h264", "265": "hevc", "hevc": "hevc"}
# By codec, which bits of the first byte of a unit state its type, and the types from which decoding can start
# (ITU-T H.264 and H.265, table 7-1 of either).
_START_TYPES: Mapping[str, tuple[Callable[[int], int], frozenset[int]]] = {
    "h264": (lambda byte: byte & 0x1F, frozenset({5, 7})),
    "hevc": (lambda byte: byte >> 1 & 0x3F, frozenset({*range(16, 22), 32, 33})),
}
# Bytes in which the first units of a packet begin, which state whether it is a keyframe: those before are short.
_MAX_HEAD = 4096


class VideoStream:
    """The packets of one topic, in the order in which they are recorded."""

    def __init__(self, limits: LimitSettings) -> None:
        self._limits = limits
        self._group: _Group | None = None

    def add(self, kind: MessageType, raw: bytes, stamp: float, where: object) -> Callable[[], Message]:
        """A function that decodes the frame of a message, which is the next one.

        Raises:
            RecordingError: it is damaged, or of another codec; when the frame is decoded.
        """
        try:
            message = kind.deserialize(raw)
            codec = _find_codec(str(getattr(message, "encoding", None) or getattr(message, "format", "")))
            data = bytes(message.data)
        except Exception as error:  # of this message only
            return partial(_fail, where, error)
        if _starts_decoding(codec, data):
            self._group = _Group(codec, self._limits)
        if self._group is None:
            return partial(_fail, where, ValueError("has no keyframe before it, and cannot be decoded"))
        frame_id = clean_frame_id(getattr(message, "header", message).frame_id)
        return Frame(self._group.decode, self._group.append(data), stamp, frame_id, where)


def is_video(kind: MessageType) -> bool:
    """Whether messages are packets of a video."""
    return kind.name in VIDEO_TYPES


def _fail(where: object, error: Exception) -> Message:
    with wrap_errors(where):
        raise error


def _find_codec(name: str) -> str:
    found = next((codec for part, codec in _CODECS.items() if part in name.lower()), "")
    if not found:
        raise ValueError(
            f"video in the format {name!r} is not supported; known are h264 and h265: republish it as Image or "
            "CompressedImage"
        )
    return found


def _starts_decoding(codec: str, data: bytes) -> bool:
    """Whether a packet, in Annex B format, is a keyframe."""
    find_type, start_types = _START_TYPES[codec]
    units = re.finditer(rb"\x00\x00\x01(.)", data[:_MAX_HEAD], re.DOTALL)
    return any(find_type(unit[1][0]) in start_types for unit in units)


class _Group:
    """A keyframe and the packets after it, with a decoder that goes on where it is."""

    def __init__(self, codec: str, limits: LimitSettings) -> None:
        self._codec, self._limits = codec, limits
        self._packets: list[bytes] = []
        self._decoder: VideoCodecContext | None = None
        self._next = 0
        self._lock = threading.Lock()

    def append(self, data: bytes) -> int:
        """The number of a packet, which is added."""
        self._packets.append(data)
        return len(self._packets) - 1

    def decode(self, number: int) -> Pixels:
        """The pixels of the frame of a packet.

        Raises:
            InputError: PyAV is not installed.
            ValueError: it is damaged.
        """
        av = import_av("videos in messages")
        with self._lock:
            if self._decoder is None or number < self._next:
                self._decoder, self._next = av.CodecContext.create(self._codec, "r"), 0
                self._decoder.thread_count = 1
                # Frames may be larger than the message states.
                self._decoder.options = {"max_pixels": str(self._limits.max_image_pixels)}
                self._decoder.flags |= av.codec.context.Flags.low_delay
            frames: list[VideoFrame] = []
            while self._next <= number:
                frames = list(self._decoder.decode(av.Packet(self._packets[self._next])))
                self._next += 1
            if not frames:  # kept back, for frames that are shown later
                frames, self._decoder = list(self._decoder.decode(None)), None
        if not frames or frames[-1].is_corrupt:
            raise ValueError("the frame of the video is damaged")
        return to_pixels(frames[-1])
