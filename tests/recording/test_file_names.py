"""Times and numbers of poses in the names of files."""

import pytest

from calgraph.recording.file_names import FileStamps, NamedFiles, interpret_names, parse_stamp, resolve_stamps


@pytest.mark.parametrize(
    ("name", "stamp"),
    [
        ("12", 12.0),
        ("12.25", 12.25),
        ("0", 0.0),
        ("1773380642", 1773380642.0),
        ("1773380642793", 1773380642.793),
        ("1773380642793311", 1773380642.793311),
        ("1773380642793311604", 1773380642.793311604),
        ("1773380642.793311604", 1773380642.793311604),
    ],
)
def test_names_are_seconds_or_their_thousandths(name: str, stamp: float) -> None:
    assert parse_stamp(name) == stamp


@pytest.mark.parametrize("name", ["pose1", "", "1.2.3", "-1", "1e3", "nan"])
def test_other_names_are_no_times(name: str) -> None:
    assert parse_stamp(name) is None


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (["pose12", "pose3"], [12, 3]),
        (["img_0001", "img_0010"], [1, 10]),
        (["frame-000123", "frame-000124"], [123, 124]),
        (["pose12_full", "pose3_full"], [12, 3]),
        (["cam0_0001", "cam0_0002"], [1, 2]),
        (["left_7_640x480", "left_08_640x480"], [7, 8]),
        (["only 4"], [4]),
        (["board5", "pose6"], [5, 6]),
    ],
)
def test_the_number_that_differs_counts_poses(names: list[str], numbers: list[int]) -> None:
    found = interpret_names(names)
    assert found.meaning == "numbers"
    assert [found.values[name] for name in names] == numbers


@pytest.mark.parametrize(
    ("name", "stamp"),
    [("left_1773380642793311604", 1773380642.793311604), ("cam2_1773380642.5_raw", 1773380642.5)],
)
def test_times_within_names_are_times(name: str, stamp: float) -> None:
    assert interpret_names([name]) == NamedFiles("times", {name: stamp})


@pytest.mark.parametrize(
    ("names", "complaint"),
    [
        (["2024-03-01_12-00-05", "2024-03-01_12-01-00"], "several numbers in the names differ"),
        (["cam0_1"], "the names have several numbers"),
        (["pose_a", "pose_b"], "pose_a has no number"),
        (["pose1_full", "pose1_target"], "pose1_full and pose1_target have the same number"),
        (["pose1", "pose01"], "pose01 and pose1 have the same number"),
        (["img_1", "img_1234567890"], "img_1234567890 has a number of more than nine digits"),
        (["cam0_1", "other_0_1_2"], "the names have several numbers"),
    ],
)
def test_ambiguous_names_are_an_error_with_the_reason(names: list[str], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        interpret_names(names)


def stamps(*folders: list[str]) -> list[FileStamps]:
    return list(resolve_stamps(interpret_names(names) for names in folders))


def test_consecutive_whole_numbers_count_poses_of_all_sensors() -> None:
    assert stamps(["0001", "0002"], ["1", "40"]) == [
        FileStamps({"0001": 10, "0002": 20}, True),
        FileStamps({"1": 10, "40": 400}, True),
    ]


def test_whole_numbers_count_poses_where_another_sensor_is_numbered() -> None:
    assert stamps(["10", "20"], ["pose10"])[0] == FileStamps({"10": 100, "20": 200}, True)


@pytest.mark.parametrize("other", [["20", "30"], ["12.5"]])
def test_whole_numbers_apart_or_beside_times_are_seconds(other: list[str]) -> None:
    assert stamps(["10", "20"], other)[0] == FileStamps({"10": 10, "20": 20}, False)


def test_a_slow_scanner_in_whole_seconds_beside_a_fast_one_keeps_its_seconds() -> None:
    assert stamps(["1", "2", "3"], ["1.1", "1.2"])[0] == FileStamps({"1": 1, "2": 2, "3": 3}, False)
