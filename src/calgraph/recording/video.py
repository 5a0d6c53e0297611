"""Video files: each has the images of one camera, whose stamps are presentation times."""

import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import LimitSettings
from calgraph.errors import InputError, RecordingError
from calgraph.geometry import Array
from calgraph.recording.content_hash import hash_content
from calgraph.recording.damage import check_fetched, check_pixel_count, wrap_errors
from calgraph.recording.images import Pixels, to_8_bits
from calgraph.recording.recording import ClosedOnExit, TopicInfo, select_topics
from calgraph.sensors import Image, MessageDigest, RecordedMessage

if TYPE_CHECKING:
    from av import VideoFrame
    from av.container import InputContainer
    from av.video.stream import VideoStream

VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".webm")
_ADVICE = "copy it again, or save what is readable with `ffmpeg -i {name} -c copy fixed{suffix}`"
# Files that miss more of the duration that they state are cut short, s: writers round it, and some leave out the
# duration of the last frame.
_MAX_MISSING = 0.5


@dataclass(frozen=True, eq=False)
class _VideoIndex:
    """The frames of a video in the order in which they are shown."""

    pts: NDArray[np.int64]
    """(N,) presentation time stamps in the units of the stream."""
    stamps: Array
    """(N,) s after the first frame."""
    keyframes: NDArray[np.intp]
    """(K,) the frames from which decoding can start, ascending."""
    digests: tuple[int, ...]
    """Hash of the encoded data of each."""
    has_times: bool
    """Whether the file has presentation times; AVI has none, so that frames which are shown in another order than
    decoded are known only by decoding from the start."""
    damage: str
    """Why frames are missing at the end; empty if none is known to be."""


class VideoRecording(ClosedOnExit):
    """A video as a recording with one topic; needs ``calgraph[video]``.

    The first frame is at 0 s. Frames are decoded when their messages are; rotations that the file states for
    players are not applied, as the sensor does not turn.

    Args:
        path: of the file.
        limits: maximum size of its images.
        topic: the name of the file without suffix if left out.

    Raises:
        InputError: PyAV is not installed.
        RecordingError: the file is damaged, has no video, or larger images than the limit.
    """

    def __init__(self, path: Path, limits: LimitSettings, topic: str | None = None) -> None:
        self.path, self.sources = path, (path,)
        self._limits = limits
        check_fetched(path)
        self._index = _index_video(path, limits)
        self._stack = ExitStack()
        stamps = self._index.stamps
        self.start, self.end = 0.0, float(stamps[-1])
        self.topics = (TopicInfo(topic or path.stem, "image", len(stamps), "start"),)

    def records(
        self, topics: Collection[str] | None = None, start: float | None = None, end: float | None = None
    ) -> Iterator[RecordedMessage]:
        """The frames in the order in which they are shown; see :meth:`Recording.records`."""
        if not select_topics(self.path, self.topics, topics):
            return iter(())
        decoder = _FrameDecoder(self.path, self._index, self._limits)
        self._stack.callback(decoder.close)
        return self._records(decoder, start, end)

    def close(self) -> None:
        """Closes the decoders."""
        self._stack.close()

    def _records(
        self, decoder: "_FrameDecoder", start: float | None, end: float | None
    ) -> Iterator[RecordedMessage]:
        topic = self.topics[0].name
        for number, stamp in enumerate(self._index.stamps.tolist()):
            if (start is None or stamp >= start) and (end is None or stamp <= end):
                digest = partial(MessageDigest, "", self._index.digests[number])
                yield RecordedMessage(
                    topic, stamp, stamp, Frame(decoder.decode, number, stamp, "", self.path), digest
                )
        if self._index.damage and start is None and end is None:
            raise RecordingError(f"{self.path}: {self._index.damage}; {_advise(self.path)}")


@dataclass(frozen=True, eq=False)
class Frame:
    """Decodes one frame; pickled as the image, so that each frame is decoded by one process."""

    decode: Callable[[int], Pixels]
    number: int
    stamp: float
    frame_id: str
    where: object
    """For the error message."""

    def __call__(self) -> Image:
        """The image; raises RecordingError if it is damaged."""
        with wrap_errors(self.where):
            return Image(self.stamp, self.frame_id, self.decode(self.number))

    def __reduce__(self) -> tuple[Any, ...]:
        image = self()
        return partial, (Image, image.stamp, image.frame_id, image.pixels)


class _FrameDecoder:
    """Decodes frames of a video: in sequence, or from the keyframe before one that is farther away.

    It has one thread, as processes are forked while it is open; the lock is for frames pickled by another thread.
    """

    def __init__(self, path: Path, index: _VideoIndex, limits: LimitSettings) -> None:
        self.index = index
        self._limits = limits
        self._path = path
        self._container: InputContainer | None = None
        self._frames: Iterator[VideoFrame] = iter(())
        self._frame: VideoFrame | None = None
        self._number = -1
        """Of the frame decoded last."""
        self._lock = threading.Lock()

    def decode(self, number: int) -> Pixels:
        """The pixels of a frame.

        Raises:
            RecordingError: it is damaged.
        """
        where = f"{self._path}: stamp {self.index.stamps[number]:.6f}"
        with self._lock, _wrap_errors(where, self._path):
            keyframe = int(self.index.keyframes[np.searchsorted(self.index.keyframes, number, side="right") - 1])
            if self._container is None or number < self._number or keyframe > self._number:
                self._seek(keyframe)
            while self._number < number:
                self._advance()
            if self._frame is None or self._number != number or self._frame.is_corrupt:
                raise ValueError("the frame is damaged or missing")
            return to_pixels(self._frame)

    def close(self) -> None:
        """Closes the file."""
        if self._container is not None:
            self._container.close()
            self._container = None

    def _seek(self, keyframe: int) -> None:
        if self._container is None:
            self._container = _open(self._path)
            context = _find_stream(self._container).codec_context
            context.thread_count = 1
            # Frames may be larger than the file states.
            context.options = {"max_pixels": str(self._limits.max_image_pixels)}
        stream = _find_stream(self._container)
        self._container.seek(int(self.index.pts[keyframe]), stream=stream)
        self._frames = self._container.decode(stream)
        self._frame, self._number = None, keyframe - 1

    def _advance(self) -> None:
        """Decodes the next frame that the index has; others belong to keyframes before."""
        for frame in self._frames:
            if not self.index.has_times:
                self._frame, self._number = frame, self._number + 1
                return
            number = int(np.searchsorted(self.index.pts, frame.pts or 0))
            if number > self._number and number < len(self.index.pts) and self.index.pts[number] == frame.pts:
                self._frame, self._number = frame, number
                return
        raise ValueError("the video ends before the frame")


def is_video(path: Path) -> bool:
    """Whether a file is a video, by its name."""
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file() and not path.name.startswith(".")


def import_av(what: object) -> Any:
    """PyAV, which reads videos.

    Raises:
        InputError: it is not installed.
    """
    try:
        import av
    except ImportError:
        raise InputError(
            f"{what}: videos need PyAV, which is not installed: pip install 'calgraph[video]'"
        ) from None
    return av


def _open(path: Path) -> "InputContainer":
    container: InputContainer = import_av(path).open(str(path))
    return container


def _find_stream(container: "InputContainer") -> "VideoStream":
    """The first video that is not a cover picture."""
    from av.stream import Disposition

    streams = [s for s in container.streams.video if not s.disposition & Disposition.attached_pic]
    if not streams:
        raise ValueError("has no video")
    return streams[0]


def _index_video(path: Path, limits: LimitSettings) -> _VideoIndex:
    """Reads the file once, without decoding."""
    with _wrap_errors(path, path), _open(path) as container:
        stream = _find_stream(container)
        check_pixel_count(stream.codec_context.width, stream.codec_context.height, limits)
        avi = container.format.name == "avi"
        packets: dict[int, tuple[bool, int]] = {}
        count, end, broken = 0, 0.0, False
        for packet in container.demux():
            time = packet.dts if avi else packet.pts
            if time is None or packet.time_base is None:
                continue
            end = max(end, float((time + (packet.duration or 0)) * packet.time_base))
            if packet.stream is stream:
                count += 1
                broken |= packet.is_corrupt
                if not packet.is_discard and not packet.is_corrupt:
                    packets[time] = packet.is_keyframe, hash_content(bytes(packet))
        if not packets:
            raise ValueError("has no video frame")
        pts = np.array(sorted(packets), dtype=np.int64)
        keyframes = np.flatnonzero([packets[one][0] for one in pts.tolist()])
        has_times = not avi or len(keyframes) == len(pts)
        can_seek = has_times and len(keyframes) and keyframes[0] == 0
        return _VideoIndex(
            pts,
            (pts - pts[0]) * float(stream.time_base or 1),
            keyframes if can_seek else np.zeros(1, dtype=np.intp),
            tuple(packets[one][1] for one in pts.tolist()),
            has_times,
            _find_damage(container, stream, count, end, broken),
        )


def _find_damage(container: "InputContainer", stream: "VideoStream", count: int, end: float, broken: bool) -> str:
    """Why frames are missing at the end; an empty text if none is known to be.

    Args:
        container: open file.
        stream: its video.
        count: frames that were found.
        end: time of the last frame or sound, s.
        broken: whether the end of a frame is missing.
    """
    name = container.format.name
    stated = 0.0
    if "matroska" in name:
        stated = (container.duration or 0) / 1e6
    elif name == "avi":
        stated = stream.frames * float(stream.time_base or 0)
    elif count < stream.frames:
        return f"is cut short: it has {count} frames and states {stream.frames}"
    if broken or stated - end > _MAX_MISSING:
        return f"is cut short: it ends at {end:.1f} s" + (f" and states {stated:.1f} s" if stated > end else "")
    return ""


def to_pixels(frame: "VideoFrame") -> Pixels:
    """(height, width) grey or (height, width, 3) BGR; deep grey values are stretched as those of images are."""
    if frame.format.name == "gray":
        return np.asarray(frame.to_ndarray(), dtype=np.uint8)
    if frame.format.name.startswith("gray"):
        return to_8_bits(frame.to_ndarray(format="gray16le"))
    return np.asarray(frame.to_ndarray(format="bgr24"), dtype=np.uint8)


def _advise(path: Path) -> str:
    return _ADVICE.format(name=path.name, suffix=path.suffix)


@contextmanager
def _wrap_errors(where: object, path: Path) -> Iterator[None]:
    """Converts exceptions of PyAV, whose texts have numbers of FFmpeg, and others into a RecordingError."""
    with wrap_errors(where, _advise(path)):
        try:
            yield
        except Exception as error:
            reason = getattr(error, "strerror", "")
            if not reason:
                raise
            raise ValueError(f"the video cannot be read ({reason})") from error
