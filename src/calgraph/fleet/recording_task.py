"""One recording of a fleet, calibrated or checked, with its files: the call that an engine evaluates."""

import logging
import shutil
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from calgraph.calibration.dispatch import calibrate
from calgraph.calibration.result_files import format_comparison, make_provenance, write_results
from calgraph.config import Rig, load_rig
from calgraph.drive.audit import compare_drive_extrinsics
from calgraph.drive.options import DriveOptions
from calgraph.fleet.plan import RecordingTask
from calgraph.fleet.pose_set import PoseSet
from calgraph.fleet.recording_result import FILE_NAME, Failure, RecordingResult, SensorResult, save_result
from calgraph.io.atomic import replace_folder_atomically, write_text
from calgraph.io.cache_folder import CacheFolder
from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import compare_network_extrinsics
from calgraph.recording import NO_CACHE, RecordingCache, open_recordings, resolve_intrinsics
from calgraph.result import Calibration, ExtrinsicsFile, read_extrinsics, state_calibrated_intrinsics
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem
from calgraph.rig.verification import compare_extrinsics
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
            if rig.is_network:
                network_options = NetworkOptions(seed=task.seed, cache=cache)
                calibration, comparison = compare_network_extrinsics(rig, recording, given, network_options)
            elif rig.is_drive:
                drive_options = DriveOptions(seed=task.seed)
                calibration, comparison = compare_drive_extrinsics(rig, recording, given, drive_options)
            else:
                problem = build_problem(rig, recording, RigOptions(seed=task.seed, cache=cache))
                calibration, comparison = compare_extrinsics(problem, given)
                rig = problem.rig
        else:
            calibration = calibrate(rig, recording, _make_options(rig, task.seed, cache))
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


def _make_options(rig: Rig, seed: int, cache: RecordingCache) -> NetworkOptions | DriveOptions | RigOptions:
    """The options of a calibration of this kind of rig."""
    if rig.is_drive:
        return DriveOptions(seed=seed)
    return NetworkOptions(seed=seed, cache=cache) if rig.is_network else RigOptions(seed=seed, cache=cache)


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
