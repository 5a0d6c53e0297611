"""Runs over fleets: failures are isolated, killed processes are survived, and results are found again."""

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import calgraph.fleet.run
from calgraph.errors import CalibrationError, WorkerKilledError
from calgraph.fleet.plan import RecordingTask
from calgraph.fleet.recording_result import FILE_NAME, Failure, RecordingResult, load_result, save_result
from calgraph.fleet.run import RunOptions, analyze_recording, analyze_recordings, find_finished
from calgraph.geometry import se3, so3
from calgraph.io.text_writing import format_yaml
from calgraph.parallel.engine import THIS_PROCESS, Processes
from calgraph.recording import RecordingWriter
from drive_scenes import scan_drive
from fleet_scenes import draw_poses, make_result, make_task, measure_poses

OPTIONS = RunOptions("calgraph fleet")


@dataclass(frozen=True)
class KillingEngine(Processes):
    """Its process is killed whenever it works on certain recordings, also when the call is repeated."""

    jobs: int = 2
    killing: frozenset[str] = frozenset()
    calls: list[str] = field(default_factory=list)

    def map(self, function: Callable[..., Any], work: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
        for arguments in work:
            task: RecordingTask = arguments[1]
            self.calls.append(task.recording)
            if task.recording in self.killing:
                raise WorkerKilledError("a process was killed")
            yield function(*arguments)


def test_each_failure_is_that_of_one_recording(tmp_path: Path) -> None:
    tasks = [make_task(tmp_path, recording=f"day-{k}") for k in range(3)]
    found = dict(analyze_recordings(tasks, OPTIONS, THIS_PROCESS))
    assert [one.failure.kind for one in found.values() if one.failure] == ["input"] * 3
    assert all("does not exist" in one.failure.message for one in found.values() if one.failure)
    assert [path.name for path in (tmp_path / "robots" / "a" / "day-1").iterdir()] == [FILE_NAME]


@pytest.mark.parametrize(("error", "kind"), [
    (ZeroDivisionError("no"), "internal"), (MemoryError(), "memory"), (CalibrationError("no board"), "data"),
])  # fmt: skip
def test_unexpected_errors_do_not_end_a_fleet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, kind: str
) -> None:
    def fail(_path: Path) -> None:
        raise error

    monkeypatch.setattr(calgraph.fleet.run, "load_rig", fail)
    failure = analyze_recording(OPTIONS, make_task(tmp_path)).failure
    assert failure is not None
    assert failure.kind == kind
    assert ("ZeroDivisionError" in failure.traceback) == (kind == "internal")


def test_warnings_are_kept_with_the_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task = make_task(tmp_path)

    def warn(_options: RunOptions, task: RecordingTask, _folder: Path) -> RecordingResult:
        for _ in range(2):
            logging.getLogger("calgraph.recording").warning("%s: is cut off", "x.mcap")
        return make_result(task, measure_poses(draw_poses(), np.random.default_rng(0)))

    monkeypatch.setattr(calgraph.fleet.run, "_analyze", warn)
    analyze_recording(OPTIONS, task)
    assert find_finished([task])[task].warnings == ("x.mcap: is cut off",)


def test_a_recording_whose_process_is_killed_twice_is_named_and_the_others_go_on(tmp_path: Path) -> None:
    tasks = [make_task(tmp_path, recording=f"day-{k}") for k in range(5)]
    engine = KillingEngine(killing=frozenset({"day-2"}))
    found = dict(analyze_recordings(tasks, OPTIONS, engine))
    kinds = {task.recording: result.failure.kind for task, result in found.items() if result.failure}
    assert kinds == {"day-0": "input", "day-1": "input", "day-2": "killed", "day-3": "input", "day-4": "input"}
    assert engine.calls == ["day-0", "day-1", "day-2", "day-3", "day-4"]
    stored = load_result(tasks[2].folder)
    assert stored is not None
    assert stored.failure == found[tasks[2]].failure


def test_results_in_folders_are_not_lost_when_a_process_is_killed(tmp_path: Path) -> None:
    class OutOfOrder(KillingEngine):
        def map(self, function: Callable[..., Any], work: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
            work = list(work)
            if len(work) > 1:
                # The second one is complete when the first one's process is killed.
                function(*work[1])
            yield from super().map(function, work)

    tasks = [make_task(tmp_path, recording=f"day-{k}") for k in range(2)]
    engine = OutOfOrder(killing=frozenset({"day-0"}))
    found = dict(analyze_recordings(tasks, OPTIONS, engine))
    assert engine.calls == ["day-0"]
    assert {task.recording: one.failure.kind for task, one in found.items() if one.failure} == {
        "day-0": "killed", "day-1": "input",
    }  # fmt: skip


def test_several_processes_give_the_same_results(tmp_path: Path) -> None:
    tasks = [make_task(tmp_path, recording=f"day-{k}") for k in range(4)]
    alone = dict(analyze_recordings(tasks, OPTIONS, THIS_PROCESS))
    both = dict(analyze_recordings(tasks, OPTIONS, Processes(2)))
    assert [one.failure for one in both.values()] == [one.failure for one in alone.values()]


def test_a_result_is_found_again_only_for_the_same_inputs(tmp_path: Path) -> None:
    task = make_task(tmp_path)
    task.folder.mkdir(parents=True)
    save_result(make_result(task, measure_poses(draw_poses(), np.random.default_rng(0))), task.folder)
    assert list(find_finished([task])) == [task]
    assert find_finished([replace(task, key="another")]) == {}


def test_failures_are_results_unless_they_are_to_be_repeated(tmp_path: Path) -> None:
    task = make_task(tmp_path)
    failed = replace(analyze_recording(OPTIONS, task))
    assert failed.failure == Failure("input", f"{task.rig}: does not exist; check the path")
    assert list(find_finished([task])) == [task]
    assert find_finished([task], retry_failed=True) == {}


@pytest.mark.slow
def test_a_drive_is_checked_without_a_board(tmp_path: Path) -> None:
    """Of a robot whose file states the pose of one of its scanners 10 cm off."""
    T = se3.pose(so3.exp(np.array([0.0, 0.0, 3.0])), np.array([-0.8, 0.2, 0.0]))
    with RecordingWriter(tmp_path / "drive") as writer:
        for topic, scans in scan_drive({"front": np.eye(4), "rear": T}, 32.0).items():
            for message in scans:
                writer.write(topic, replace(message, stamp=1e9 + message.stamp), 1e9 + message.stamp)
    sensors = {name: {"kind": "lidar2d", "topic": f"/{name}"} for name in ("front", "rear")}
    rig = {"root": "front", "target": {"kind": "surroundings"}, "sensors": sensors}
    (tmp_path / "rig.yaml").write_text(format_yaml(rig))
    found = []
    for shift in (0.0, 0.1):
        frame = {"header": {"frame_id": "front"}, "child_frame_id": "rear"}
        turn = dict(zip("xyzw", so3.quaternion(T[:3, :3]).tolist(), strict=True))
        place = dict(zip("xyz", (T[:3, 3] + [shift, 0, 0]).tolist(), strict=True))
        transform = {**frame, "transform": {"translation": place, "rotation": turn}}
        (tmp_path / "given.yaml").write_text(format_yaml({"transforms": [transform]}))
        task = replace(
            make_task(tmp_path), action="check", rig=tmp_path / "rig.yaml", path=tmp_path / "drive",
            reference=tmp_path / "given.yaml",
        )  # fmt: skip
        found.append(analyze_recording(OPTIONS, task))
    right, wrong = found
    assert right.failure is wrong.failure is None
    assert right.failed_checks == ()
    assert wrong.failed_checks == ("rear",)
    assert (tmp_path / "robots" / "a" / "day-0" / "check.json").is_file()
