"""Recordings that are given together: which were made together, and which one after the other."""

import logging
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

from calgraph.errors import InputError
from calgraph.recording import Recording, RecordingWriter, open_recordings
from calgraph.sensors import LaserScan, Trigger

Write = Callable[..., Path]


def scan(stamp: float, seed: int) -> LaserScan:
    """A measurement with its own noise."""
    ranges = np.random.default_rng([seed, round(1e3 * stamp)]).uniform(1.0, 5.0, 40)
    return LaserScan(float(stamp), "laser", np.linspace(-1.0, 1.0, 40), ranges)


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Writes a bag with scans that arrive when they were measured."""

    def write_bag(name: str, stamps: Iterable[float], topics: Iterable[str] = ("/a",), *, seed: int = 0) -> Path:
        with RecordingWriter(tmp_path / name) as writer:
            for stamp in stamps:
                for topic in topics:
                    writer.write(topic, scan(stamp, seed))
        return tmp_path / name

    return write_bag


def stamps_of(recording: Recording, topic: str) -> list[float]:
    return [round(record.stamp, 3) for record in recording.records([topic])]


def test_a_second_recording_from_the_same_stamps_on_comes_after_the_first(write: Write) -> None:
    paths = [write("one", np.arange(0, 10, 0.5), seed=1), write("two", np.arange(0, 8, 0.5), seed=2)]
    with open_recordings(paths) as recording:
        stamps = stamps_of(recording, "/a")
    np.testing.assert_allclose(stamps[:20], np.arange(0, 10, 0.5))
    np.testing.assert_allclose(stamps[20:], 69.5 + np.arange(0, 8, 0.5))


@pytest.mark.parametrize("start", [1.7e9, 1.7e9 + 6.25, 1.7e9 - 8.5])
def test_any_overlap_of_a_sensor_begins_a_take_that_keeps_the_times_between_its_messages(
    write: Write, start: float
) -> None:
    first = write("one", 1.7e9 + np.arange(0, 10, 0.5), seed=1)
    second = write("two", start + np.arange(0, 10, 0.5), ("/a", "/b"), seed=2)
    with open_recordings([first, second]) as recording:
        of_a, of_b = stamps_of(recording, "/a")[20:], stamps_of(recording, "/b")
        decoded = [record.decode().stamp for record in recording.records(["/b"])]
    assert of_a == of_b == [round(stamp, 3) for stamp in decoded]
    assert of_b[0] >= 1.7e9 + 9.5 + 60.0
    np.testing.assert_allclose(np.diff(of_b), 0.5, atol=1e-6)


def test_a_recording_of_each_computer_is_one_take(write: Write) -> None:
    paths = [write("left", np.arange(0, 10, 0.5), ("/a",)), write("right", np.arange(0.1, 10, 0.5), ("/b",))]
    with open_recordings(paths) as recording:
        assert stamps_of(recording, "/b")[0] == 0.1
        assert recording.end - recording.start < 10.0


@pytest.mark.parametrize("order", [[0, 1, 2, 3], [0, 2, 1, 3], [2, 3, 0, 1]])
def test_two_takes_of_two_computers_are_paired_in_any_order(write: Write, order: list[int]) -> None:
    paths = [
        write("left_1", np.arange(0, 5, 0.5), ("/a",), seed=1),
        write("right_1", np.arange(0.1, 5, 0.5), ("/b",), seed=1),
        write("left_2", np.arange(0, 6, 0.5), ("/a",), seed=2),
        write("right_2", np.arange(0.2, 6, 0.5), ("/b",), seed=2),
    ]
    with open_recordings([paths[i] for i in order]) as recording:
        shift = {0: [0.1, 0.2], 2: [0.2, 0.1]}[order[0]]
        of_a, of_b = stamps_of(recording, "/a"), stamps_of(recording, "/b")
    lengths = (10, 12) if order[0] == 0 else (12, 10)
    assert np.diff([of_a[0], of_b[0]])[0] == pytest.approx(shift[0])
    assert of_b[lengths[0]] - of_a[lengths[0]] == pytest.approx(shift[1])


def test_topics_of_no_sensor_may_be_recorded_by_both_computers(tmp_path: Path) -> None:
    for name, topic in (("left", "/a"), ("right", "/b")):
        with RecordingWriter(tmp_path / name) as writer:
            for stamp in np.arange(0, 5, 0.5):
                writer.write(topic, scan(stamp, 1))
                writer.write("/trigger", Trigger(float(stamp)))
    with open_recordings([tmp_path / "left", tmp_path / "right"]) as recording:
        assert recording.end - recording.start < 5.0


def test_parts_of_a_split_recording_are_one_take_even_if_one_message_is_out_of_order(write: Write) -> None:
    stamps = 1.7e9 + np.arange(0, 30, 0.5)
    stamps[20] -= 0.6  # the first message of the second file was measured before the last one of the first
    paths = [write(name, part) for name, part in zip("abc", np.split(stamps, 3), strict=True)]
    with open_recordings(paths[::-1]) as recording:
        assert sorted(stamps_of(recording, "/a")) == sorted(round(stamp, 3) for stamp in stamps)


def test_recordings_at_different_hours_keep_their_stamps(write: Write) -> None:
    paths = [write("one", 1000 + np.arange(5.0)), write("two", 9000 + np.arange(5.0))]
    with open_recordings(paths) as recording:
        assert (recording.start, recording.end) == (1000.0, 9004.0)


def test_recordings_of_one_message_each_at_the_same_stamp_are_takes(write: Write) -> None:
    paths = [write(f"pose{n}", [5.0], ("/a", "/b"), seed=n) for n in range(4)]
    with open_recordings(paths) as recording:
        assert stamps_of(recording, "/a") == stamps_of(recording, "/b") == [5.0, 65.0, 125.0, 185.0]


def test_stamps_count_though_the_recordings_arrived_at_different_times(tmp_path: Path) -> None:
    """Stamps of simulated time, or of a clock that starts with the robot."""
    for name, arrival in (("one", 1000.0), ("two", 5000.0)):
        with RecordingWriter(tmp_path / name) as writer:
            for stamp in np.arange(0, 10, 0.5):
                writer.write("/a", scan(stamp, int(arrival)), arrival=arrival + stamp)
    with open_recordings([tmp_path / "one", tmp_path / "two"]) as recording:
        stamps = stamps_of(recording, "/a")
    assert stamps[20] - stamps[19] >= 60.0
    assert len(set(stamps)) == 40


@pytest.mark.parametrize("kind", ["path", "link", "copy", "other format"])
def test_one_recording_under_two_names_is_an_error(tmp_path: Path, write: Write, kind: str) -> None:
    first = write("one", np.arange(0, 5, 0.5))
    second = tmp_path / "two"
    if kind == "path":
        second = first
    elif kind == "link":
        second.symlink_to(first)
    elif kind == "copy":
        shutil.copytree(first, second)
    else:
        with RecordingWriter(second.with_suffix(".mcap")) as writer:
            for stamp in np.arange(0, 5, 0.5):
                writer.write("/a", scan(stamp, 0))
        second = second.with_suffix(".mcap")
    with pytest.raises(InputError, match=rf"{second.name}: has the same messages of /a as .*one: give one of"):
        open_recordings([first, second])


def test_corners_of_another_program_given_twice_are_an_error(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        rows = ["sync_index,cam_id,point_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y,obj_loc_z"]
        rows += [f"{n},0,{k},{10 * k},{20 + n},{0.1 * k},0,0" for n in range(3) for k in range(4)]
        (tmp_path / name / "xy.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"two.*: has the same messages of cam_0 as"):
        open_recordings([tmp_path / "one/xy.csv", tmp_path / "two/xy.csv"])


def test_messages_that_two_computers_both_recorded_are_an_error_even_where_some_were_lost(write: Write) -> None:
    stamps = np.arange(0, 10, 0.5)
    first = write("left", stamps[stamps != 2.0], ("/a", "/b"))
    second = write("right", stamps[3:], ("/b", "/c"))
    with pytest.raises(InputError, match=r"right: has the same messages of /b as .*left"):
        open_recordings([first, second])


def test_equal_messages_at_the_start_do_not_make_two_takes_the_same(tmp_path: Path) -> None:
    """Simulated scanners without noise measure the same in an empty room."""
    for seed, name in enumerate(("one", "two")):
        with RecordingWriter(tmp_path / name) as writer:
            for stamp in np.arange(0, 20, 0.5):
                writer.write("/a", scan(stamp, 0 if stamp < 15 else seed))
    with open_recordings([tmp_path / "one", tmp_path / "two"]) as recording:
        assert recording.end == 99.0


def test_what_is_one_take_is_logged(write: Write, caplog: pytest.LogCaptureFixture) -> None:
    one, other = write("one", np.arange(0, 5, 0.5), seed=1), write("other", np.arange(0, 5, 0.5), ("/b",), seed=1)
    two = write("two", np.arange(1, 5, 0.5), seed=2)
    with caplog.at_level(logging.WARNING), open_recordings([one, two, other]):
        pass
    lines = caplog.messages[0].splitlines()
    assert lines[0] == "2 takes, read one after the other, because sensors repeat at overlapping stamps:"
    assert lines[1:] == [f"  take 1: {one}, {other} (0.0 to 4.5 s)", f"  take 2: {two} (64.5 to 68.0 s)"]
    caplog.clear()
    with caplog.at_level(logging.WARNING), open_recordings([one, other]):
        assert caplog.messages == [f"one take: {one}, {other}"]
