"""Videos as messages, as Foxglove and ffmpeg_image_transport record them; needs PyAV."""

import pickle
import sys
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import foxglove.messages as fox
import numpy as np
import pytest
from mcap.writer import Writer
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from calgraph.errors import InputError, RecordingError
from calgraph.recording import find_topics, open_recording
from calgraph.recording.driver_types import DEFINITIONS
from calgraph.sensors import Image

av = pytest.importorskip("av")

FFMPEG = "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
SIZE = (48, 64)


def pixels(number: int) -> NDArray[np.uint8]:
    """A ramp that becomes brighter by 3 from frame to frame."""
    return np.repeat(np.add.outer(np.zeros(SIZE[0]), np.arange(SIZE[1]))[:, :, None], 3, axis=2).astype(
        np.uint8
    ) + np.uint8(3 * number)


def encode(count: int, codec: str = "libx264") -> Iterator[bytes]:
    """Packets of a video with a keyframe every 10 frames, as streams have them."""
    context = av.CodecContext.create(codec, "w")
    context.width, context.height, context.pix_fmt = SIZE[1], SIZE[0], "yuv420p"
    context.time_base, context.gop_size = Fraction(1, 10), 10
    context.options = {"preset": "ultrafast", "tune": "zerolatency", "crf": "5", "x265-params": "log-level=none"}
    for number in range(count):
        frame = av.VideoFrame.from_ndarray(pixels(number), format="bgr24")
        frame.pts = number
        yield from (bytes(packet) for packet in context.encode(frame))
    yield from (bytes(packet) for packet in context.encode(None))


def write(path: Path, packets: list[bytes], form: str = "h264", ffmpeg: bool = False) -> Path:
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(DEFINITIONS[FFMPEG], FFMPEG))
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2" if ffmpeg else "")
        schema = fox.CompressedVideo.get_schema()
        if ffmpeg:
            text = store.generate_msgdef(FFMPEG, ros_version=2)[0].encode()
            number = writer.register_schema(FFMPEG, "ros2msg", text)
        else:
            number = writer.register_schema(schema.name, "protobuf", schema.data)
        channel = writer.register_channel("/video", "cdr" if ffmpeg else "protobuf", number)
        for k, packet in enumerate(packets):
            if ffmpeg:
                time = store.types["builtin_interfaces/msg/Time"](100 + k, 0)
                header = store.types["std_msgs/msg/Header"](time, "cam")
                message: Any = store.types[FFMPEG](
                    header, SIZE[1], SIZE[0], form, k, 0, False, np.frombuffer(packet, np.uint8)
                )
                data = bytes(store.serialize_cdr(message, FFMPEG))
            else:
                data = fox.CompressedVideo(
                    timestamp=fox.Timestamp(100 + k, 0), frame_id="cam", data=packet, format=form
                ).encode()
            writer.add_message(channel, (100 + k) * 10**9, data, (100 + k) * 10**9)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def check(message: object, number: int) -> None:
    assert isinstance(message, Image)
    assert (message.stamp, message.frame_id) == (100.0 + number, "cam")
    # Below half of what frames differ by; the colours of grey are off by more than its green.
    assert np.abs(message.pixels[:, :, 1].astype(int) - pixels(number)[:, :, 1]).mean() < 1.4


@pytest.mark.parametrize(
    ("codec", "form", "ffmpeg"),
    [
        ("libx264", "h264", False), ("libx264", "libx264", True), ("libx264", "h264;yuv420p;bgr8;bgr8", True),
        ("libx265", "h265", False), ("libx265", "hevc", True),
    ],
)  # fmt: skip
def test_frames_of_videos_are_images(tmp_path: Path, codec: str, form: str, ffmpeg: bool) -> None:
    path = write(tmp_path / "a.mcap", list(encode(25, codec)), form, ffmpeg)
    with open_recording(path) as recording:
        (topic,) = find_topics(recording)
        for number, record in enumerate(recording.records()):
            check(record.decode(), number)
    assert (topic.kind, topic.frame_id, topic.problem) == ("camera", "cam", "")


def test_frames_may_be_decoded_in_any_order_and_from_any_time(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", list(encode(40)))
    with open_recording(path) as recording:
        records = list(recording.records(start=127.0, end=133.0))
        assert [record.stamp for record in records] == [127.0 + k for k in range(7)]
        for record in [records[k] for k in (6, 0, 3, 2, 5)]:
            check(record.decode(), round(record.stamp - 100))
        check(pickle.loads(pickle.dumps(records[1].decode))(), 28)  # noqa: S301


def test_frames_before_the_first_keyframe_are_named_and_others_read(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", list(encode(25))[5:])
    with open_recording(path) as recording:
        records = list(recording.records())
        with pytest.raises(RecordingError, match=r"topic /video, stamp 100\.0.*has no keyframe before it"):
            records[0].decode()
        assert isinstance(records[5].decode(), Image)


def test_other_formats_are_named(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [b"abc"], "vp9")
    with open_recording(path) as recording, pytest.raises(RecordingError, match="format 'vp9' is not supported"):
        next(recording.records()).decode()


def test_damaged_packets_are_errors(tmp_path: Path) -> None:
    packets = list(encode(10))
    rng = np.random.default_rng(0)
    damaged = [bytes(p[:8]) + rng.integers(0, 256, len(p) - 8, dtype=np.uint8).tobytes() for p in packets]
    with open_recording(write(tmp_path / "a.mcap", damaged)) as recording:
        for record in recording.records():
            try:
                record.decode()
            except RecordingError:
                continue


def test_without_pyav_the_error_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "a.mcap", list(encode(1)))
    monkeypatch.setitem(sys.modules, "av", None)
    with open_recording(path) as recording, pytest.raises(InputError, match=r"pip install 'calgraph\[video\]'"):
        next(recording.records()).decode()
