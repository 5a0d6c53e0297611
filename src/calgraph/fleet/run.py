"""A run over a fleet: recordings that have no result yet are given to an engine, and results are collected."""

import logging
import shutil
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from calgraph.calibration.dispatch import calibrate, compare, make_options
from calgraph.calibration.result_files import format_comparison, make_provenance, write_results
from calgraph.config import ChangeRules, Rig, load_rig
from calgraph.errors import WorkerKilledError
from calgraph.fleet.changes import Comparison, Move, compare_poses, pair_recordings
from calgraph.fleet.plan import RecordingTask, RobotPlan
from calgraph.fleet.recording_result import (
    FILE_NAME,
    Failure,
    PoseSet,
    RecordingResult,
    SensorResult,
    load_result,
    save_result,
)
from calgraph.io.atomic import replace_folder_atomically, write_text
from calgraph.io.cache_folder import CacheFolder
from calgraph.parallel.engine import Engine
from calgraph.recording import NO_CACHE, RecordingCache, open_recordings, resolve_intrinsics
from calgraph.result import Calibration, ExtrinsicsFile, read_extrinsics, state_calibrated_intrinsics
from calgraph.verdict.comparison import ExtrinsicsComparison


@dataclass(frozen=True)
class RunOptions:
    """What all recordings of a run share, and no result depends on."""

    command: str
    """For the provenance."""
    cache: CacheFolder | None = None
    """Of detections."""


def analyze_recording(options: RunOptions, task: RecordingTask) -> RecordingResult:
    """Calibrates or checks one recording, and writes its folder, recording.json last.

    Any error is that of this recording alone: it is part of the result, not raised.

    Raises:
        InputError: the folder cannot be written to.
    """
    began = time.monotonic()
    try:
        with replace_folder_atomically(task.folder, FILE_NAME) as folder, _collect_warnings() as warnings:
            result = _analyze(options, task, folder)
            result = replace(result, seconds=time.monotonic() - began, warnings=tuple(warnings))
            save_result(result, folder)
    except Exception as error:  # of one recording, which the others do not depend on
        failure = Failure.of(error, traceback.format_exc())
        result = write_failure(task, failure, time.monotonic() - began)
    return result


@contextmanager
def _collect_warnings() -> Iterator[list[str]]:
    """The warnings that are logged in the block; they are logged as well."""

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if record.getMessage() not in found:
                found.append(record.getMessage())

    found: list[str] = []
    collector = Collector(logging.WARNING)
    logger = logging.getLogger("calgraph")
    logger.addHandler(collector)
    try:
        yield found
    finally:
        logger.removeHandler(collector)


def write_failure(task: RecordingTask, failure: Failure, seconds: float = 0.0) -> RecordingResult:
    """Replaces the folder of a recording by one that states its failure.

    Raises:
        InputError: it cannot be written to.
    """
    result = RecordingResult(task.robot, task.recording, str(task.path), task.key, seconds, failure)
    shutil.rmtree(task.folder, ignore_errors=True)
    with replace_folder_atomically(task.folder, FILE_NAME) as folder:
        save_result(result, folder)
    return result


def _analyze(options: RunOptions, task: RecordingTask, folder: Path) -> RecordingResult:
    rig = load_rig(task.rig)
    given = read_extrinsics(task.reference) if task.reference else None
    cache = RecordingCache(options.cache.path, options.cache.max_bytes) if options.cache else NO_CACHE
    comparison = None
    with open_recordings([task.path], rig.settings.limits) as recording:
        if task.action == "check" and given:
            calibration, comparison, rig = compare(rig, recording, given, seed=task.seed, cache=cache)
        else:
            calibration = calibrate(rig, recording, make_options(rig, seed=task.seed, cache=cache))
            rig = state_calibrated_intrinsics(resolve_intrinsics(rig, recording), calibration)
        inputs: list[tuple[str, Path | str]] = [("rig", task.rig), ("recording", task.path)]
        if task.reference:
            inputs.append(("reference", task.reference))
        provenance = make_provenance(options.command, inputs, recording, cache)
    calibration = replace(calibration, provenance=provenance)
    write_results(calibration, rig, folder)
    if comparison and task.reference:
        write_text(folder / "check.json", format_comparison(comparison, task.reference, rig.tolerance) + "\n")
    return _describe(task, calibration, rig, given, comparison)


def _describe(
    task: RecordingTask,
    calibration: Calibration,
    rig: Rig,
    given: ExtrinsicsFile | None,
    comparison: ExtrinsicsComparison | None,
) -> RecordingResult:
    """What a fleet keeps of a calibration."""
    compared = {one.sensor: one for one in comparison.sensors} if comparison else {}
    sensors = [
        SensorResult(one.name, one.kind, one.verdict.grade, one.verdict.reason) for one in calibration.sensors
    ] + [
        SensorResult(name, rig.sensors[name].kind, "unconnected", reason)
        for name, reason in calibration.evidence.unconnected.items()
    ]
    provenance = calibration.provenance
    return RecordingResult(
        robot=task.robot,
        recording=task.recording,
        path=str(task.path),
        key=task.key,
        seconds=0.0,
        start=provenance.start if provenance else None,
        duration=provenance.duration if provenance else None,
        sensors=tuple(
            replace(one, outcome=compared[one.name].outcome, difference=compared[one.name].reason)
            if one.name in compared
            else one
            for one in sensors
        ),
        poses=PoseSet.from_calibration(calibration),
        reference=PoseSet.from_extrinsics(given, calibration) if given else None,
    )


_KILLED_TWICE = "its process was killed twice, perhaps because memory ran out; give a shorter recording"


@dataclass(frozen=True, eq=False)
class RobotResult:
    """The results of one robot's recordings, in the order of time."""

    plan: RobotPlan
    recordings: tuple[RecordingResult, ...]
    """Those that are done."""
    comparisons: tuple[Comparison, ...]

    @property
    def name(self) -> str:
        """Of the robot."""
        return self.plan.name

    @property
    def moves(self) -> tuple[tuple[Comparison, Move], ...]:
        """What moved when: between successive recordings, and since the start where no such step shows."""
        found: list[tuple[Comparison, Move]] = []
        for comparison in self.comparisons:
            for move in comparison.moves:
                named = {name for _, earlier in found for name in earlier.sensors}
                if comparison.since == "previous" or not named & set(move.sensors):
                    found.append((comparison, move))
        return tuple(found)

    @property
    def failures(self) -> tuple[tuple[str, Failure], ...]:
        """Names of the recordings that failed, and why; without a name, why the robot has none."""
        of_plan = [("", Failure("input", self.plan.problem))] if self.plan.problem else []
        return (*of_plan, *((one.recording, one.failure) for one in self.recordings if one.failure))

    @property
    def pending(self) -> int:
        """Number of recordings that have no result yet."""
        return len(self.plan.tasks) - len(self.recordings)

    @property
    def states(self) -> tuple[str, ...]:
        """What needs attention, the most urgent first: keys of ``STATES`` of the page; or good."""
        done = [one for one in self.recordings if not one.failure]
        found = {
            "failed": bool(self.failures),
            "moved": bool(self.moves),
            "off": any(one.failed_checks for one in done),
            "lost": any(one.lost for one in done),
            "warned": any(one.warnings for one in done),
            "weak": any(one.is_weak for one in done),
            "pending": self.pending > 0,
        }
        return tuple(state for state, holds in found.items() if holds) or ("good",)

    @property
    def is_acceptable(self) -> bool:
        """Whether nothing failed, moved, is off or lost."""
        return not {"failed", "moved", "off", "lost", "pending"} & set(self.states)


def find_finished(
    tasks: Sequence[RecordingTask], *, retry_failed: bool = False
) -> dict[RecordingTask, RecordingResult]:
    """The results that earlier runs left, of the same inputs.

    Args:
        tasks: all recordings.
        retry_failed: whether failures do not count as results.
    """
    loaded = ((task, load_result(task.folder)) for task in tasks)
    return {
        task: result
        for task, result in loaded
        if result and result.key == task.key and not (retry_failed and result.failure)
    }


def analyze_recordings(
    tasks: Sequence[RecordingTask], options: RunOptions, engine: Engine
) -> Iterator[tuple[RecordingTask, RecordingResult]]:
    """Calibrates or checks recordings; each result is in its folder before it is given.

    A recording whose process is killed, also when the engine repeats it, has failed; the others go on.

    Raises:
        InputError: the folder of the results cannot be written to.
        CalibrationError: the engine cannot go on for another reason.
    """
    remaining = list(tasks)
    for task in remaining:
        (task.folder / FILE_NAME).unlink(missing_ok=True)
    while remaining:
        try:
            for result in engine.map(analyze_recording, [(options, task) for task in remaining]):
                yield remaining.pop(0), result
        except WorkerKilledError:
            killed = remaining.pop(0)
            yield killed, write_failure(killed, Failure("killed", _KILLED_TWICE))
            # Later ones may be complete, but were not given.
            finished = find_finished(remaining)
            yield from finished.items()
            remaining = [task for task in remaining if task not in finished]


def collect_robots(
    plans: Sequence[RobotPlan], results: dict[RecordingTask, RecordingResult], rules: ChangeRules
) -> tuple[RobotResult, ...]:
    """The results by robot, with the changes from recording to recording.

    The probability of a false alarm is divided by the number of comparisons in the fleet (Bonferroni).
    """
    done = {plan.name: tuple(results[task] for task in plan.tasks if task in results) for plan in plans}
    pairs = {name: pair_recordings(of_robot) for name, of_robot in done.items()}
    share = rules.false_alarm_probability / max(sum(map(len, pairs.values())), 1)
    return tuple(
        RobotResult(plan, done[plan.name], tuple(compare_poses(pair, rules, share) for pair in pairs[plan.name]))
        for plan in plans
    )
