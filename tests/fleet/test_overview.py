"""The page and the tables of a fleet."""

import re
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calgraph.config import ChangeRules
from calgraph.fleet.page import format_turn, render_page
from calgraph.fleet.plan import RobotPlan
from calgraph.fleet.recording_result import Failure, RecordingResult
from calgraph.fleet.run import RobotResult, collect_robots
from calgraph.fleet.tables import write_tables
from fleet_scenes import draw_poses, make_robot, make_task, measure_poses

STEP = np.array([0.0, 0.01, 0.0, 0.0, 0.0, 0.0])
RULES = ChangeRules()


@pytest.fixture
def robots(tmp_path: Path) -> tuple[RobotResult, ...]:
    """One robot that is good, one whose camera moved, one that failed, and one without recordings."""
    rng = np.random.default_rng(0)
    good = make_robot(tmp_path, "good", [measure_poses(draw_poses(), rng) for _ in range(2)])
    moved = make_robot(
        tmp_path, "moved", [measure_poses(draw_poses(), rng, m, 5e-4) for m in ({}, {"camera": STEP})]
    )
    task = make_task(tmp_path, "broken")
    failure = Failure("input", "x.mcap: is <b>empty</b>")
    failed = RecordingResult("broken", "day-0", "x.mcap", "key", 0.1, failure)
    plans = [good[0], moved[0], RobotPlan("broken", (task,)), RobotPlan("none", problem="no recording matches x")]
    return collect_robots(plans, good[1] | moved[1] | {task: failed}, RULES)


def test_states_name_what_needs_attention(robots: tuple[RobotResult, ...]) -> None:
    assert {robot.name: robot.states for robot in robots} == {
        "good": ("good",), "moved": ("moved",), "broken": ("failed",), "none": ("failed",),
    }  # fmt: skip
    assert [robot.is_acceptable for robot in robots] == [True, False, False, False]


def test_the_page_begins_with_what_is_urgent_and_links_the_reports(robots: tuple[RobotResult, ...]) -> None:
    page = render_page(robots, RULES, "1.0")
    rows = re.findall(r'<tr data-states="(\w+)"><th scope="row">([\w-]+)', page)
    assert [state for state, _ in rows] == ["failed", "failed", "moved", "good"]
    assert 'href="robots/moved/day-1/report.html"' in page
    assert 'href="robots/broken/day-0/report.html"' not in page
    assert re.search(r"camera moved by \d+\.\d ± 0\.\d+ mm and .* between day-0 and day-1", page)


def test_messages_are_escaped_and_nothing_is_loaded(robots: tuple[RobotResult, ...]) -> None:
    page = render_page(robots, RULES, "1.0")
    assert "x.mcap: is &lt;b&gt;empty&lt;/b&gt;" in page
    assert not re.findall(r"https?://", page)


def test_the_drift_of_a_moved_sensor_is_drawn_above_the_others(robots: tuple[RobotResult, ...]) -> None:
    row = next(row for row in render_page(robots, RULES, "1.0").split("<tr ") if 'scope="row">moved' in row)
    lines = re.findall(r'<path( class="moved")? d="M4 32L128 ([\d.]+)', row)
    assert [bool(moved) for moved, _ in lines] == [False, True]
    assert float(lines[1][1]) < 10 < 25 < float(lines[0][1])


def test_the_page_of_a_thousand_robots_opens(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    made = [
        make_robot(tmp_path, f"robot-{k}", [measure_poses(draw_poses(), rng) for _ in range(4)]) for k in range(50)
    ]
    results = {task: result for _, of_robot in made for task, result in of_robot.items()}
    robots = collect_robots([plan for plan, _ in made], results, RULES)
    plans = [replace(robot.plan, name=f"{robot.name}-{k}") for robot in robots for k in range(20)]
    thousand = [replace(robots[k // 20], plan=plan) for k, plan in enumerate(plans)]
    assert len(render_page(thousand, RULES, "1.0").encode()) < 4e6


def test_tables_have_poses_changes_and_moves(robots: tuple[RobotResult, ...], tmp_path: Path) -> None:
    path = tmp_path / "fleet.sqlite"
    write_tables(robots, "1.0", path)
    with closing(sqlite3.connect(path)) as tables:
        assert tables.execute("SELECT format FROM fleet").fetchone() == ("calgraph-fleet/1",)
        assert tables.execute("SELECT robot, state FROM robots ORDER BY robot").fetchall() == [
            ("broken", "failed"), ("good", "good"), ("moved", "moved"), ("none", "failed"),
        ]  # fmt: skip
        failures = tables.execute("SELECT robot, failure, message FROM recordings WHERE state = 'failed'")
        assert failures.fetchall() == [("broken", "input", "x.mcap: is <b>empty</b>")]
        poses = tables.execute("SELECT x, y, z, qw, sigma_x FROM poses WHERE sensor = 'camera'").fetchall()
        assert len(poses) == 4
        assert {round(row[-1], 6) for row in poses} == {0.001, 0.0005}
        ((sensor, distance, sigma),) = tables.execute(
            "SELECT sensor, distance, sigma_distance FROM moves WHERE robot = 'moved'"
        ).fetchall()
        assert sensor == "camera"
        assert abs(distance - 0.01) < 4 * sigma
        ((found,),) = tables.execute("SELECT count(*) FROM changes WHERE since = 'previous'").fetchall()
        assert found == 4


def test_what_is_not_finite_is_null(robots: tuple[RobotResult, ...], tmp_path: Path) -> None:
    poses = robots[0].recordings[0].poses
    assert poses is not None
    poses.covariance[6:12] = np.nan
    write_tables(robots[:1], "1.0", tmp_path / "fleet.sqlite")
    with closing(sqlite3.connect(tmp_path / "fleet.sqlite")) as tables:
        found = tables.execute("SELECT sigma_x FROM poses WHERE sensor = 'camera' AND recording = 'day-0'")
        assert found.fetchall() == [(None,)]


def test_turns_of_rounding_are_zero() -> None:
    assert format_turn(7e-15, np.radians(0.048)) == "0° ± 0.048°"
    assert format_turn(np.radians(0.31), np.radians(0.048)) == "0.31° ± 0.048°"
