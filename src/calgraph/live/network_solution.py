"""The calibration of a network from what has been recorded until now.

Poses, covariances and verdicts are those of ``calgraph calibrate`` on the same tracks.
"""

import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from calgraph.config import Rig
from calgraph.errors import CalgraphError, Rejected
from calgraph.geometry import Array
from calgraph.live.floor_grid import FloorGrid, build_floor_grid
from calgraph.live.tracked_intervals import (
    Tracked,
    TrackingProgress,
    join_tracks,
    remove_files,
    select_intervals,
    track_recording,
)
from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import calibrate_tracks
from calgraph.network.tracking.track import ScannerTracks
from calgraph.network.tracking.track_scanner import MAX_SCAN_GAP
from calgraph.recording import Recording, open_recording
from calgraph.recording.input_checks import InputMonitor
from calgraph.result import Calibration, SensorPose
from calgraph.result.calibration import UNMEASURED_IN_PLANE
from calgraph.verdict.grades import max_good_stddev

# Axes that a network measures: x, y, yaw.
_MEASURED = np.delete(np.arange(6), UNMEASURED_IN_PLANE)


@dataclass(frozen=True, eq=False)
class ScannerSolution:
    """What is known of one scanner's pose."""

    name: str
    tracks: int = 0
    """Number of tracks of people."""
    T_root_scanner: Array | None = None
    """(4, 4); None as long as nothing connects the scanner to the root."""
    covariance: Array | None = None
    """(2, 2) of the position in the root's axes, m²."""
    stddev: Array | None = None
    """(3,) along x and y of the scanner, m, and of yaw, rad; zero for the root."""
    uncertainty: float = float("inf")
    """Largest ratio of a standard deviation to the largest with which errors are within the tolerance."""
    grade: str = ""
    """good, weak or unobservable; empty without a pose."""
    reason: str = ""
    """Why it is not good, or not connected, in words."""
    clock_offset: float | None = None
    """Its clock minus the root's, s; None where that is not known."""
    clock_offset_stddev: float | None = None

    @property
    def progress(self) -> float:
        """1 where all errors are within the tolerance with the probability of verdicts, less before; 0..1."""
        return min(1.0, 1 / max(self.uncertainty, 1e-9))


@dataclass(frozen=True, eq=False)
class LiveNetworkSolution:
    """The calibration of a network from what was recorded until some time."""

    scanners: tuple[ScannerSolution, ...]
    """In the order of rig.yaml."""
    grid: FloorGrid | None
    """Walls, where people walked and where they should; None as long as nothing is connected."""
    start: float
    """Arrival of the first message, s."""
    end: float
    """Arrival up to which messages were used, s."""
    recorded: float
    """Duration of what was recorded until then, s, without the time between two runs of a session."""
    used: float
    """Duration of what was used of that, s."""
    progress: TrackingProgress = field(default_factory=TrackingProgress)
    """For the next solution."""
    seconds: float = 0.0
    """That it took to compute, s."""
    problem: str = ""
    """Why there is no calibration, if there is none."""
    remarks: tuple[str, ...] = ()
    """Of the calibration as a whole."""

    @property
    def done(self) -> bool:
        """Whether all scanners have good poses."""
        return bool(self.scanners) and all(scanner.grade == "good" for scanner in self.scanners)


def solve_recording(
    rig: Rig, path: Path, folder: Path, last: LiveNetworkSolution | None
) -> LiveNetworkSolution | None:
    """Calibrates a network from its recording until now.

    Args:
        rig: the network.
        path: of the recording, which may still be written to.
        folder: where tracks are kept; empty before the first call.
        last: the last solution from the same recording and folder.

    Returns:
        The solution; None as long as the recording has no message.
    """
    begin = time.perf_counter()
    with _without_warnings():
        try:
            recording = open_recording(path, rig.settings.limits)
        except CalgraphError:
            return None  # its first chunk is not complete yet
        with recording:
            solution = _solve(rig, recording, folder, last, begin)
    remove_files(folder, solution.progress.intervals)
    return solution


# Processor time of a solution, s, above which the next is computed from fewer intervals; those that add least are
# left out. Five scanners and two people need 2 s for each minute, 8 s where their legs are modelled.
_MAX_WORK = 20.0


def _solve(
    rig: Rig, recording: Recording, folder: Path, last: LiveNetworkSolution | None, begin: float
) -> LiveNetworkSolution:
    monitor = InputMonitor(rig, recording.start)
    found = track_recording(rig, recording, folder, last.progress if last else TrackingProgress(), monitor)
    tracked = join_tracks(found.parts, MAX_SCAN_GAP)
    calibration: Calibration | None = None
    problem, work = "", time.process_time()
    try:
        calibration = calibrate_tracks(
            rig, tracked, NetworkOptions(), start=recording.start, findings=monitor.findings()
        )
    except CalgraphError as error:
        problem = str(error)
    rows = calibration.evidence.captures if calibration else ()
    max_positions = found.positions * _MAX_WORK / max(time.process_time() - work, 1e-3)
    used = select_intervals(found.progress.intervals, rows, recording.start, max_positions)
    scanners = _describe_scanners(rig, tracked, calibration)
    return LiveNetworkSolution(
        scanners,
        build_floor_grid(calibration, tracked, _find_unfinished(scanners)) if calibration else None,
        recording.start,
        found.end,
        found.progress.duration + found.rest,
        sum(interval.duration for interval in found.progress.intervals) + found.rest,
        replace(found.progress, intervals=used),
        time.perf_counter() - begin,
        problem,
        calibration.further_remarks if calibration else (),
    )


def _find_unfinished(scanners: tuple[ScannerSolution, ...]) -> tuple[str, ...]:
    """Names of the connected scanners that are not within tolerance."""
    return tuple(one.name for one in scanners if one.T_root_scanner is not None and one.grade != "good")


def _describe_scanners(rig: Rig, tracked: Tracked, calibration: Calibration | None) -> tuple[ScannerSolution, ...]:
    poses = {sensor.name: sensor for sensor in calibration.sensors} if calibration else {}
    unconnected: Mapping[str, str] = calibration.evidence.unconnected if calibration else {}
    limits = max_good_stddev(rig.tolerance, rig.settings.diagnostics.verdict)[_MEASURED]
    scanners = []
    for name in rig.sensors:
        found = tracked[name]
        count = len(found.tracks) if isinstance(found, ScannerTracks) else 0
        # A root to which nothing is connected is no result.
        if name in poses and len(poses) > 1:
            scanners.append(_describe_pose(poses[name], count, limits))
        else:
            reason = unconnected.get(name, found.reason if isinstance(found, Rejected) else "")
            scanners.append(ScannerSolution(name, count, reason=reason))
    return tuple(scanners)


def _describe_pose(sensor: SensorPose, tracks: int, limits: Array) -> ScannerSolution:
    stddev = sensor.axis_stddev[_MEASURED]
    return ScannerSolution(
        sensor.name,
        tracks,
        sensor.T_root_sensor,
        sensor.measured_covariance[:2, :2],
        stddev,
        float(np.max(stddev / limits)),
        sensor.verdict.grade,
        sensor.verdict.reason,
        sensor.clock_offset,
        sensor.clock_offset_stddev,
    )


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Recordings that are being written to have no end, which needs no warning."""
    log = logging.getLogger("calgraph.recording")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(level)
