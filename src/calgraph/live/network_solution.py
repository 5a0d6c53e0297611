"""The calibration of a network from what has been recorded until now.

Poses, covariances and verdicts are those of ``calgraph calibrate`` on the same tracks.
"""

import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from calgraph.config import Rig
from calgraph.errors import CalgraphError, Rejected
from calgraph.geometry import Array
from calgraph.live.floor_grid import FloorGrid, build_floor_grid
from calgraph.live.recorded_files import open_growing
from calgraph.live.sensor_solution import SensorSolution, Solution, describe_sensors
from calgraph.live.tracked_intervals import (
    RecordingWindow,
    TrackingProgress,
    join_tracks,
    select_intervals,
    track_recording,
)
from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import calibrate_network, calibrate_tracks
from calgraph.network.space.pipeline import has_lidars
from calgraph.network.tracking.track import ScannerTracks
from calgraph.network.tracking.track_scanner import MAX_SCAN_GAP
from calgraph.recording import Recording
from calgraph.recording.input_checks import InputMonitor
from calgraph.result import Calibration


@dataclass(frozen=True, eq=False)
class LiveNetworkSolution(Solution):
    """The calibration of a network from what was recorded until some time."""

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
    T_plan_root: Array = field(default_factory=lambda: np.eye(4))
    """(4, 4) pose of the root on the plan of the floor."""


def solve_recording(rig: Rig, path: Path, last: LiveNetworkSolution | None) -> LiveNetworkSolution | None:
    """Calibrates a network from its recording until now.

    Args:
        rig: the network.
        path: of the recording, which may still be written to.
        last: the last solution from the same recording.

    Returns:
        The solution; None as long as the recording has no message.
    """
    begin = time.perf_counter()
    with open_growing(path, rig.settings.limits) as recording:
        if recording is None:
            return None
        if has_lidars(rig):
            return _solve_in_space(rig, recording, begin)
        return _solve(rig, recording, last, begin)


# Time of a recording of 3-D LiDARs that is calibrated, the last, s: four of 32 rings take 0.6 s of work for each.
_MAX_DURATION = 60.0


def _solve_in_space(rig: Rig, recording: Recording, begin: float) -> LiveNetworkSolution:
    end, recorded = recording.end, recording.end - recording.start
    window = RecordingWindow(recording, max(recording.start, end - _MAX_DURATION), end)
    calibration: Calibration | None = None
    problem = ""
    try:
        calibration = calibrate_network(rig, window, NetworkOptions())
    except CalgraphError as error:
        problem = str(error)
    scanners = tuple(
        replace(one, tracks=_count_tracks(calibration, one.name)) for one in describe_sensors(rig, calibration)
    )
    return LiveNetworkSolution(
        scanners,
        build_floor_grid(calibration) if calibration else None,
        recording.start,
        end,
        recorded,
        window.end - window.start,
        seconds=time.perf_counter() - begin,
        problem=problem,
        remarks=calibration.further_remarks if calibration else (),
        T_plan_root=calibration.pictures.T_plan_root if calibration else np.eye(4),
    )


def _count_tracks(calibration: Calibration | None, name: str) -> int:
    views = calibration.pictures.floor_views if calibration else ()
    return sum(len(view.tracks) for view in views if view.sensor == name)


# Processor time of a solution, s, above which the next is computed from fewer intervals; those that add least are
# left out. Five scanners and two people need 2 s for each minute, 8 s where their legs are modelled.
_MAX_WORK = 20.0


def _solve(rig: Rig, recording: Recording, last: LiveNetworkSolution | None, begin: float) -> LiveNetworkSolution:
    monitor = InputMonitor(rig, recording.start)
    progress, rest = track_recording(rig, recording, last.progress if last else TrackingProgress(), monitor)
    intervals = (*progress.intervals, rest) if rest else progress.intervals
    tracked = join_tracks([interval.tracked for interval in intervals], MAX_SCAN_GAP)
    calibration: Calibration | None = None
    problem, work = "", time.process_time()
    try:
        calibration = calibrate_tracks(
            rig, tracked, NetworkOptions(), start=recording.start, findings=monitor.findings()
        )
    except CalgraphError as error:
        problem = str(error)
    rows = calibration.evidence.captures if calibration else ()
    positions = sum(interval.positions for interval in intervals)
    max_positions = positions * _MAX_WORK / max(time.process_time() - work, 1e-3)
    used = select_intervals(progress.intervals, rows, recording.start, max_positions)
    scanners = tuple(_add_tracks(one, tracked[one.name]) for one in describe_sensors(rig, calibration))
    return LiveNetworkSolution(
        scanners,
        build_floor_grid(calibration) if calibration else None,
        recording.start,
        rest.end if rest else progress.until or recording.start,
        progress.duration + (rest.duration if rest else 0.0),
        sum(interval.duration for interval in intervals),
        replace(progress, intervals=used),
        time.perf_counter() - begin,
        problem,
        calibration.further_remarks if calibration else (),
    )


def _add_tracks(scanner: SensorSolution, found: ScannerTracks | Rejected) -> SensorSolution:
    """With the number of tracks, or why there are none."""
    if isinstance(found, Rejected):
        return replace(scanner, reason=scanner.reason or found.reason)
    return replace(scanner, tracks=len(found.tracks))
