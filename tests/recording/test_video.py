"""Videos: the stamps of their frames, frames in any order, damage, and limits."""

import pickle
import sys
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest

from calgraph.config.settings import LimitSettings
from calgraph.errors import InputError, RecordingError
from calgraph.parallel.engine import Processes
from calgraph.recording import open_recording, open_recordings, video
from calgraph.sensors import Image, RecordedMessage
from videos import write_video

STAMPS = [0.05 * i + 0.025 * (i % 2) for i in range(40)]
"""Of a variable frame rate."""
GRAYS = [np.full((48, 64), 20 + 5 * i, np.uint8) for i in range(40)]
"""The number of a frame is seen in its pixels."""


def number_of(record: RecordedMessage) -> float:
    message = record.decode()
    assert isinstance(message, Image)
    assert message.stamp == record.stamp
    return (float(message.gray.mean()) - 20) / 5


@pytest.fixture
def cut(tmp_path: Path) -> Path:
    """A video without its last third."""
    noise = np.random.default_rng(0).integers(0, 255, (40, 48, 64), dtype=np.uint8)
    data = write_video(tmp_path / "whole.mkv", list(noise), STAMPS).read_bytes()
    (tmp_path / "cut.mkv").write_bytes(data[: 2 * len(data) // 3])
    return tmp_path / "cut.mkv"


@pytest.mark.parametrize(
    ("name", "codec", "b_frames"),
    [
        ("cam0.mp4", "mpeg4", 2),
        ("cam0.mov", "mpeg4", 0),
        ("cam0.mkv", "libx264", 2),
        ("cam0.webm", "libvpx", 0),
        ("cam0.AVI", "mjpeg", 0),
        ("cam0.avi", "libx264", 2),
    ],
)
def test_frames_are_read_in_any_order_with_their_stamps(
    tmp_path: Path, name: str, codec: str, b_frames: int
) -> None:
    path = write_video(tmp_path / name, GRAYS, STAMPS, codec=codec, b_frames=b_frames)
    with open_recording(path) as recording:
        records = list(recording.records())
        assert [record.topic for record in records] == ["cam0"] * 40
        np.testing.assert_allclose([record.stamp for record in records], STAMPS, atol=1e-9)
        assert (recording.start, recording.end) == (0.0, records[-1].stamp)
        order = [*range(40), *np.random.default_rng(0).permutation(40).tolist()]
        np.testing.assert_allclose([number_of(records[i]) for i in order], order, atol=0.4)


def test_stamps_count_from_the_first_frame(tmp_path: Path) -> None:
    path = write_video(tmp_path / "late.mkv", GRAYS[:3], [1.5, 1.6, 1.8])
    with open_recording(path) as recording:
        np.testing.assert_allclose([record.stamp for record in recording.records()], [0, 0.1, 0.3])


def test_an_interval_has_the_frames_within(tmp_path: Path) -> None:
    path = write_video(tmp_path / "cam.mkv", GRAYS, STAMPS)
    with open_recording(path) as recording:
        records = list(recording.records(["cam"], 0.99, 1.11))
        assert [round(number_of(record)) for record in records] == [20, 21, 22]


def test_a_frame_can_be_sent_to_another_process(tmp_path: Path) -> None:
    path = write_video(tmp_path / "cam.mp4", GRAYS, STAMPS)
    with open_recording(path) as recording:
        sent = pickle.dumps(list(recording.records())[17].decode)
    image = pickle.loads(sent)()  # noqa: S301 - made above
    assert round((image.gray.mean() - 20) / 5) == 17


def test_frames_have_digests_of_their_content(tmp_path: Path) -> None:
    path = write_video(tmp_path / "cam.avi", [GRAYS[3], GRAYS[4], GRAYS[3]], STAMPS[:3], codec="mjpeg")
    with open_recording(path) as recording:
        digests = [record.digest() for record in recording.records() if record.digest]
    assert digests[0] == digests[2] != digests[1]


def test_rotation_for_players_does_not_turn_the_images(tmp_path: Path) -> None:
    path = write_video(tmp_path / "phone.mp4", GRAYS[:2], STAMPS[:2], rotation=90)
    with av.open(str(path)) as container:
        assert next(container.decode(video=0)).rotation != 0
    with open_recording(path) as recording:
        message = next(recording.records()).decode()
    assert isinstance(message, Image)
    assert message.pixels.shape[:2] == (48, 64)


def test_frames_before_the_end_of_a_video_cut_short_are_read_then_it_is_an_error(cut: Path) -> None:
    with open_recording(cut) as recording:
        records = recording.records()
        assert all(next(records).decode() for _ in range(recording.topics[0].count))
        assert 20 < recording.topics[0].count < 30
        with pytest.raises(RecordingError, match=r"cut\.mkv: is cut short: it ends at 1\.\d s and states 2\.0 s"):
            next(records)


def test_a_video_without_index_is_an_error_with_advice(tmp_path: Path) -> None:
    data = write_video(tmp_path / "whole.mp4", GRAYS, STAMPS).read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) // 2])
    with pytest.raises(
        RecordingError, match=r"cut\.mp4: the video cannot be read .* -i cut\.mp4 -c copy fixed\.mp4"
    ):
        open_recording(tmp_path / "cut.mp4")


def test_a_damaged_frame_is_an_error_with_its_stamp(tmp_path: Path) -> None:
    path = write_video(tmp_path / "cam.avi", GRAYS, STAMPS, codec="mjpeg")
    with av.open(str(path)) as container:
        packet = [packet for packet in container.demux(video=0) if packet.size][7]
    data = bytearray(path.read_bytes())
    assert packet.pos is not None
    data[packet.pos + 8 : packet.pos + 8 + packet.size] = bytes(packet.size)
    path.write_bytes(bytes(data))
    with open_recording(path) as recording:
        records = list(recording.records())
        with pytest.raises(RecordingError, match=r"cam\.avi: stamp 0\.375000: "):
            records[7].decode()


def test_other_files_named_like_videos_are_errors(tmp_path: Path) -> None:
    (tmp_path / "notes.mp4").write_text("no video")
    with pytest.raises(RecordingError, match=r"notes\.mp4: the video cannot be read"):
        open_recording(tmp_path / "notes.mp4")


def test_sound_alone_is_an_error(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "sound.mkv"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        assert isinstance(stream, av.AudioStream)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
    with pytest.raises(RecordingError, match=r"sound\.mkv: has no video"):
        open_recording(tmp_path / "sound.mkv")


def test_frames_larger_than_the_limit_are_an_error_before_any_is_decoded(tmp_path: Path) -> None:
    path = write_video(tmp_path / "cam.mkv", GRAYS[:2], STAMPS[:2])
    limits = LimitSettings(max_image_pixels=48 * 64 - 1)
    with pytest.raises(RecordingError, match="image states 64 x 48 pixels, more than the limit of 3071"):
        open_recording(path, limits)


def test_frames_larger_than_the_file_states_are_an_error(tmp_path: Path) -> None:
    path = write_video(tmp_path / "cam.avi", GRAYS[:2], STAMPS[:2])
    index = video._index_video(path, LimitSettings())
    decoder = video._FrameDecoder(path, index, LimitSettings(max_image_pixels=100))
    with pytest.raises(RecordingError, match=r"cam\.avi: stamp 0\.0"):
        decoder.decode(0)
    decoder.close()


def test_without_pyav_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_video(tmp_path / "cam.mkv", GRAYS[:2], STAMPS[:2])
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"cam\.mkv: videos need PyAV.*pip install 'calgraph\[video\]'"):
        open_recording(path)


def test_a_folder_has_one_video_a_camera_beside_folders_of_other_sensors(tmp_path: Path) -> None:
    for name in ("left.mp4", "right.mp4"):
        write_video(tmp_path / name, GRAYS[:2], [0.0, 0.5])
    (tmp_path / "lidar").mkdir()
    np.savez(tmp_path / "lidar" / "0.25.npz", points=np.ones((1, 3)))
    with open_recording(tmp_path) as recording:
        assert recording.path == tmp_path
        assert [(r.topic, r.stamp) for r in recording.records()] == [
            ("left", 0.0),
            ("right", 0.0),
            ("lidar", 0.25),
            ("left", 0.5),
            ("right", 0.5),
        ]


def test_a_video_alone_in_a_folder_has_its_topic(tmp_path: Path) -> None:
    """As cameras name their files themselves."""
    for camera in ("left", "right"):
        (tmp_path / camera).mkdir()
        write_video(tmp_path / camera / "GX010012.MP4", GRAYS[:2], [0.0, 0.5])
    with open_recording(tmp_path) as recording:
        assert [(topic.name, topic.count) for topic in recording.topics] == [("left", 2), ("right", 2)]


def mean_gray(decode: Callable[[], Image]) -> float:
    return float(decode().gray.mean())


def test_frames_are_the_same_in_several_processes(tmp_path: Path) -> None:
    path = write_video(tmp_path / "cam.mp4", GRAYS, STAMPS, b_frames=2)
    with open_recording(path) as recording:
        here = list(Processes(1).map(mean_gray, ((r.decode,) for r in recording.records())))
        there = list(Processes(2).map(mean_gray, ((r.decode,) for r in recording.records())))
    assert here == there
    assert len(here) == 40


def test_several_videos_are_one_recording_and_another_of_the_same_name_is_the_next_take(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    a = write_video(tmp_path / "a.mp4", GRAYS[:2], [0.0, 0.5])
    b = write_video(tmp_path / "b/a.mkv", GRAYS[2:4], [0.0, 0.5])
    other = write_video(tmp_path / "b.mp4", GRAYS[:2], [0.0, 0.5])
    with open_recordings([a, other]) as recording:
        assert [topic.name for topic in recording.topics] == ["a", "b"]
    with open_recordings([a, other, b]) as recording:
        records = list(recording.records())
        assert [(r.topic, r.stamp) for r in records[-2:]] == [("a", 60.5), ("a", 61.0)]
        assert records[-1].decode().stamp == 61.0


def test_two_videos_of_one_name_in_a_folder_are_an_error(tmp_path: Path) -> None:
    for name in ("a.mp4", "a.mkv"):
        write_video(tmp_path / name, GRAYS[:2], [0.0, 0.5])
    with pytest.raises(InputError, match="has two videos, or a video and a folder, of the name a: rename one"):
        open_recording(tmp_path)


def test_images_beside_videos_that_are_no_recording_do_not_matter(tmp_path: Path) -> None:
    write_video(tmp_path / "cam.mp4", GRAYS[:2], [0.0, 0.5])
    (tmp_path / "previews").mkdir()
    for name in ("poster.png", "previews/best of all.png"):
        (tmp_path / name).write_bytes(b"")
    with open_recording(tmp_path) as recording:
        assert [(topic.name, topic.count) for topic in recording.topics] == [("cam", 2)]
