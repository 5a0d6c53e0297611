"""Anomalies that an inspection reports."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from calgraph.recording import RecordingWriter, TopicReport, find_topics, inspect_recording, open_recording
from calgraph.sensors import CameraInfo, CameraModel, Image, LaserScan, PointCloud

STAMPS = 1000.0 + 0.1 * np.arange(50)


def inspected(place: Path, stamps: Sequence[float] | np.ndarray, delays: float | np.ndarray = 0.01) -> TopicReport:
    """A recording of one scanner with these stamps and arrivals."""
    with RecordingWriter(place / "bag") as writer:
        for stamp, delay in zip(stamps, np.broadcast_to(delays, len(stamps)), strict=True):
            scan = LaserScan(float(stamp), "laser", np.linspace(-1, 1, 11), np.full(11, 2.0))
            writer.write("/scan", scan, float(stamp + delay))
    with open_recording(place / "bag") as recording:
        [topic] = inspect_recording(recording, lambda _: None).topics
    return topic


def test_a_steady_sensor_has_a_rate_and_no_anomaly(tmp_path: Path) -> None:
    topic = inspected(tmp_path, STAMPS)
    assert topic.timing is not None
    assert topic.timing.rate == pytest.approx(10, abs=1e-3)
    assert topic.findings == ()


def test_the_first_message_is_described(tmp_path: Path) -> None:
    topic = inspected(tmp_path, STAMPS)
    described = (topic.kind, topic.frame_id, topic.content)
    assert described == ("lidar2d", "laser", "11 beams over 115°, 11 with a range")


def test_jitter_is_that_of_the_period(tmp_path: Path, rng: np.random.Generator) -> None:
    periods = 0.1 + rng.normal(0, 0.004, 400)
    timing = inspected(tmp_path, 1000 + np.cumsum(periods)).timing
    assert timing is not None
    assert timing.jitter == pytest.approx(0.004, rel=0.15)


def test_a_gap_is_found_with_its_time(tmp_path: Path) -> None:
    topic = inspected(tmp_path, np.delete(STAMPS, slice(20, 40)))
    assert topic.findings == ("silent for over 4 periods once, longest 2.1 s at 1.9 s",)


def test_stamps_that_go_backwards_are_found(tmp_path: Path) -> None:
    stamps = STAMPS.copy()
    stamps[[10, 11]] = stamps[[11, 10]]
    findings = inspected(tmp_path, stamps, STAMPS + 0.01 - stamps).findings
    assert findings == ("stamps go backwards once, by up to 100 ms, first at 1.1 s",)


def test_repeated_stamps_are_found(tmp_path: Path) -> None:
    stamps = STAMPS.copy()
    stamps[7] = stamps[6]
    assert inspected(tmp_path, stamps).findings == ("once a message has the stamp of the one before",)


def test_stamps_that_were_never_set_are_found(tmp_path: Path) -> None:
    topic = inspected(tmp_path, np.zeros(50), STAMPS)
    assert topic.findings == ("all header stamps are zero: the time of arrival is taken",)


@pytest.mark.parametrize(
    ("delay", "words"),
    [
        (3600.0, "are of another time zone: they are 3600.000 s behind those of the others, by when "),
        (-0.3, "are of another clock: they are 0.300 s ahead of those of the others, by when "),
    ],
)
def test_another_clock_is_found(tmp_path: Path, delay: float, words: str) -> None:
    [finding] = inspected(tmp_path, STAMPS, delay).findings
    assert finding.startswith(f"its stamps {words}")


def test_a_clock_that_runs_away_is_found(tmp_path: Path) -> None:
    findings = inspected(tmp_path, STAMPS, np.linspace(0.01, 0.11, 50)).findings
    assert findings == ("its clock runs slow against the recorder's, by 92 ms in all",)


def test_a_slow_sweep_may_arrive_a_period_late(tmp_path: Path) -> None:
    assert inspected(tmp_path, 1000 + 5.0 * np.arange(12), 5.1).findings == ()


def test_a_single_message_has_no_rate(tmp_path: Path) -> None:
    timing = inspected(tmp_path, STAMPS[:1]).timing
    assert timing is not None
    assert (timing.rate, timing.longest_gap) == (None, None)


@pytest.fixture
def kinds(tmp_path: Path) -> Iterator[dict[str, tuple[str, str]]]:
    """Kind and frame by topic, of one message each."""
    camera = CameraModel("pinhole", 4, 3, np.array([[5.0, 0, 1.5], [0, 5, 1], [0, 0, 1]]), np.zeros(5))
    with RecordingWriter(tmp_path / "bag") as writer:
        writer.write("/image", Image(1.0, "optical", np.zeros((3, 4), np.uint8)))
        writer.write("/info", CameraInfo(1.0, "optical", camera))
        writer.write("/cloud", PointCloud(1.0, "lidar", np.eye(3)))
        writer.write("/flat", PointCloud(1.0, "laser", np.eye(3) * (1, 1, 0)))
    with open_recording(tmp_path / "bag") as recording:
        yield {topic.name: (topic.kind, topic.frame_id) for topic in find_topics(recording)}


def test_topics_are_found_by_what_they_hold(kinds: dict[str, tuple[str, str]]) -> None:
    assert kinds == {
        "/image": ("camera", "optical"),
        "/info": ("camera_info", "optical"),
        "/cloud": ("lidar3d", "lidar"),
        "/flat": ("lidar2d", "laser"),
    }


def test_stamps_a_few_milliseconds_ahead_are_of_the_same_clock(tmp_path: Path) -> None:
    assert inspected(tmp_path, STAMPS, -0.011).findings == ()


def test_a_recording_without_messages_is_reported(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag"):
        pass
    with open_recording(tmp_path / "bag") as recording:
        inspection = inspect_recording(recording, lambda _: None)
    assert (inspection.duration, inspection.topics) == (0.0, ())
    assert inspection.damage.startswith(f"{tmp_path / 'bag'}: holds no message")


def numbered(place: Path, first: int) -> TopicReport:
    """The left one of two folders of three photos; those of the right one are numbered from 5."""
    for side, start in (("left", first), ("right", 5)):
        (place / side).mkdir()
        for number in range(start, start + 3):
            cv2.imwrite(str(place / side / f"IMG_{number:04}.png"), np.zeros((4, 6), dtype=np.uint8))
    with open_recording(place) as recording:
        return inspect_recording(recording, lambda _: None).topics[0]


def test_numbered_files_have_numbers_instead_of_times(tmp_path: Path) -> None:
    topic = numbered(tmp_path, 6)
    assert (topic.timing, topic.pose_numbers, topic.findings) == (None, (6, 8), ())


def test_photos_that_each_camera_counts_by_itself_are_named(tmp_path: Path) -> None:
    [finding] = numbered(tmp_path, 2041).findings
    assert finding.startswith("its files have the numbers 2041 to 2043, those of the others 5 to 7")
