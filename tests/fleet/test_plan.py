"""Plans: patterns, names of folders that stay, and keys by content."""

import os
from pathlib import Path

import pytest

from calgraph.config import FleetConfig
from calgraph.fleet.plan import RobotPlan, plan_fleet


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A fleet of one robot, with three recordings and a rig that are not looked into."""
    for name in ("a/2.mcap", "a/10.mcap", "a/1.mcap", "a/days/monday/recording.mcap", "rigs/a.yaml"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    return tmp_path


def plan(folder: Path, *recordings: str, seed: int = 0) -> RobotPlan:
    content = {"rig": "rigs/{robot}.yaml", "recordings": recordings, "robots": {"a": {}}}
    (found,) = plan_fleet(FleetConfig.model_validate(content), folder, folder / "out", seed)
    return found


def test_matches_are_in_the_order_of_the_numbers_in_their_names(folder: Path) -> None:
    tasks = plan(folder, "{robot}/*.mcap").tasks
    assert [task.path.name for task in tasks] == ["1.mcap", "2.mcap", "10.mcap"]
    assert [task.folder for task in tasks] == [folder / "out" / "robots" / "a" / n for n in ("1", "2", "10")]
    assert {task.rig for task in tasks} == {folder / "rigs" / "a.yaml"}


@pytest.mark.parametrize(
    ("pattern", "name"),
    [
        ("{robot}/2.mcap", "2"),
        ("{robot}/days/*/recording.mcap", "monday_recording"),
        ("{robot}/days/monday/recording.mcap", "days_monday_recording"),
        ("**/monday/*.mcap", "days_monday_recording"),
    ],
)
def test_folders_have_the_names_that_a_pattern_does_not_fix(folder: Path, pattern: str, name: str) -> None:
    assert [task.recording for task in plan(folder, pattern).tasks] == [name]


def test_names_of_earlier_recordings_stay_when_others_are_added(folder: Path) -> None:
    before = plan(folder, "{robot}/days/*/recording.mcap").tasks
    (folder / "a" / "days" / "tuesday").mkdir()
    (folder / "a" / "days" / "tuesday" / "recording.mcap").write_text("more")
    assert plan(folder, "{robot}/days/*/recording.mcap").tasks[: len(before)] == before


def test_equal_names_are_distinguished(folder: Path) -> None:
    (folder / "b").mkdir()
    (folder / "b" / "1.mcap").write_text("another")
    tasks = plan(folder, "a/1.*", "b/1.*").tasks
    assert [task.recording for task in tasks] == ["1", "1_2"]


def test_a_pattern_without_a_match_is_the_problem_of_its_robot(folder: Path) -> None:
    assert plan(folder, "{robot}/*.bag") == RobotPlan("a", problem="no recording matches a/*.bag")


def test_a_recording_is_given_once(folder: Path) -> None:
    assert "is given twice" in plan(folder, "{robot}/*.mcap", "{robot}/1.mcap").problem


def test_a_missing_path_is_left_to_the_calibration(folder: Path) -> None:
    assert [task.path.name for task in plan(folder, "{robot}/3.mcap").tasks] == ["3.mcap"]


@pytest.mark.parametrize("changed", ["a/1.mcap", "rigs/a.yaml"])
def test_another_content_has_another_key_and_another_time_has_not(folder: Path, changed: str) -> None:
    (before,) = plan(folder, "{robot}/1.mcap").tasks
    os.utime(folder / changed, (1, 1))
    assert plan(folder, "{robot}/1.mcap").tasks[0].key == before.key
    (folder / changed).write_text("something else")
    assert plan(folder, "{robot}/1.mcap").tasks[0].key != before.key


def test_another_seed_has_another_key(folder: Path) -> None:
    (one,), (other,) = plan(folder, "a/1.mcap").tasks, plan(folder, "a/1.mcap", seed=1).tasks
    assert one.key != other.key
