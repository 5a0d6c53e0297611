"""fleet.sqlite: recordings, poses, changes and moves of a fleet, as tables for other programs."""

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np

from calgraph.fleet.recording_result import RecordingResult
from calgraph.fleet.run import RobotResult
from calgraph.geometry import Array, so3
from calgraph.io.atomic import write_atomically

FORMAT = "calgraph-fleet/1"
_AXES = ("x", "y", "z", "rx", "ry", "rz")
_SIGMAS = tuple(f"sigma_{axis}" for axis in _AXES)
_REAL = " REAL, ".join
_SCHEMA = f"""
CREATE TABLE fleet (format TEXT NOT NULL, version TEXT NOT NULL);
CREATE TABLE robots (
    robot TEXT PRIMARY KEY, state TEXT NOT NULL, recordings INTEGER NOT NULL, failed INTEGER NOT NULL,
    pending INTEGER NOT NULL, message TEXT NOT NULL
);
CREATE TABLE recordings (
    robot TEXT NOT NULL, recording TEXT NOT NULL, position INTEGER NOT NULL, path TEXT NOT NULL,
    folder TEXT NOT NULL, state TEXT NOT NULL, failure TEXT, message TEXT, start REAL, duration REAL,
    seconds REAL NOT NULL, PRIMARY KEY (robot, recording)
);
CREATE TABLE poses (
    robot TEXT NOT NULL, recording TEXT NOT NULL, sensor TEXT NOT NULL, kind TEXT NOT NULL, root TEXT,
    grade TEXT NOT NULL, reason TEXT NOT NULL, outcome TEXT, difference TEXT NOT NULL,
    x REAL, y REAL, z REAL, qx REAL, qy REAL, qz REAL, qw REAL, {_REAL(_SIGMAS)} REAL,
    PRIMARY KEY (robot, recording, sensor)
);
CREATE TABLE changes (
    robot TEXT NOT NULL, sensor TEXT NOT NULL, since TEXT NOT NULL, earlier TEXT NOT NULL, later TEXT NOT NULL,
    {_REAL(_AXES)} REAL, {_REAL(_SIGMAS)} REAL,
    distance REAL NOT NULL, sigma_distance REAL, angle REAL NOT NULL, sigma_angle REAL,
    PRIMARY KEY (robot, sensor, since, later)
);
CREATE TABLE moves (
    robot TEXT NOT NULL, sensor TEXT NOT NULL, alternatives TEXT NOT NULL, earlier TEXT NOT NULL,
    later TEXT NOT NULL, distance REAL NOT NULL, sigma_distance REAL, angle REAL NOT NULL, sigma_angle REAL
);
"""
Row = tuple[object, ...]


def write_tables(robots: Sequence[RobotResult], version: str, path: Path) -> None:
    """Writes fleet.sqlite in one step.

    Args:
        robots: results.
        version: of calgraph.
        path: of the file.

    Raises:
        InputError: it cannot be written.
    """
    tables = {
        "robots": [_robot_row(robot) for robot in robots],
        "recordings": [row for robot in robots for row in _recording_rows(robot)],
        "poses": [row for robot in robots for one in robot.recordings for row in _pose_rows(one)],
        "changes": [row for robot in robots for row in _change_rows(robot)],
        "moves": [row for robot in robots for row in _move_rows(robot)],
    }
    with write_atomically(path) as temporary, closing(sqlite3.connect(temporary)) as database, database:
        database.executescript(_SCHEMA)
        database.execute("INSERT INTO fleet VALUES (?, ?)", (FORMAT, version))
        for name, rows in tables.items():
            if rows:
                places = ", ".join("?" * len(rows[0]))
                database.executemany(f"INSERT INTO {name} VALUES ({places})", rows)


def _robot_row(robot: RobotResult) -> Row:
    failed = sum(bool(one.failure) for one in robot.recordings)
    message = robot.plan.problem
    return robot.name, robot.states[0], len(robot.plan.tasks), failed, robot.pending, message


def _recording_rows(robot: RobotResult) -> Iterator[Row]:
    position = {task.recording: number for number, task in enumerate(robot.plan.tasks)}
    for one in robot.recordings:
        failure = one.failure
        state = "failed" if failure else "off" if one.failed_checks else "lost" if one.lost else ""
        warnings = "\n".join(one.warnings) or None
        yield (
            one.robot, one.recording, position[one.recording], one.path,
            f"robots/{one.robot}/{one.recording}",
            state or ("warned" if warnings else "weak" if one.is_weak else "good"),
            failure.kind if failure else None, failure.message if failure else warnings,
            one.start, one.duration, one.seconds,
        )  # fmt: skip


def _pose_rows(result: RecordingResult) -> Iterator[Row]:
    poses = result.poses
    for sensor in result.sensors:
        numbers: list[float | None] = [None] * 13
        if poses and sensor.name in poses.names:
            k = poses.names.index(sensor.name)
            T = poses.T_root_sensor[k]
            with np.errstate(invalid="ignore"):
                stddev = np.sqrt(np.diag(poses.covariance)[6 * k : 6 * k + 6])
            numbers = _numbers(np.concatenate([T[:3, 3], so3.quaternion(T[:3, :3]), stddev]))
        yield (
            result.robot, result.recording, sensor.name, sensor.kind, poses.names[0] if poses else None,
            sensor.grade, sensor.reason, sensor.outcome, sensor.difference, *numbers,
        )  # fmt: skip


def _change_rows(robot: RobotResult) -> Iterator[Row]:
    for one in robot.comparisons:
        for change in one.changes:
            numbers = _numbers(np.concatenate([change.step, change.stddev, change.lengths]))
            yield robot.name, change.sensor, one.since, one.earlier, one.later, *numbers


def _move_rows(robot: RobotResult) -> Iterator[Row]:
    for one, move in robot.moves:
        sensor, *others = move.sensors
        yield robot.name, sensor, ", ".join(others), one.earlier, one.later, *_numbers(np.array(move.lengths))


def _numbers(values: Array) -> list[float | None]:
    """Numbers; what is not finite is NULL."""
    return [value if np.isfinite(value) else None for value in values.tolist()]
