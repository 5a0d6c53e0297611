"""When the beams of 2-D scanners measured a moving board whose messages do not state it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from calgraph.boards.detections import BoardCorners, Detection, PlanePatch, Segment
from calgraph.config import Rig
from calgraph.errors import RecordingError, Rejected
from calgraph.geometry import Array, se3
from calgraph.recording import Recording
from calgraph.result.finding import Finding
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.captures.moving_board import compensate_motion
from calgraph.rig.captures.timeline import RecordingTimeline
from calgraph.rig.pairs.board_pair import estimate_pair
from calgraph.sensors import LaserScan
from calgraph.sensors.untimed_scans import UntimedScans, decide_turn, describe_turning
from calgraph.solver.grouped_errors import solve_with_grouped_errors

# Unknowns of a scanner and another sensor beside what all share: pose and clock.
_UNKNOWNS = 7
# Minimum number of matches of two sensors per unknown: fewer leave no residuals to estimate errors from.
_MIN_MATCHES = 2 * _UNKNOWNS
# Largest distance of the halves of a segment from the plane of another sensor, m: of a board at 1 m/s in 0.1 s.
_MAX_DISTANCE = 0.1
# Displacement of the board within the scans below which times of beams do not matter, m: clocks take the mean of
# it, and what is left is some millimetres, as large as the systematic errors of ranges.
_MAX_DISPLACEMENT = 0.005


@dataclass(frozen=True, eq=False)
class UntimedScanner:
    """A scanner whose messages do not state when each beam was measured."""

    angles: Array
    """(B,) of its beams, rad."""
    period: float
    """From one scan to the next, s."""

    def measure_times(self, bearings: Array, turn: int) -> Array:
        """Times after the stamp at bearings (N,), s, of a turn of 1, or of -1: against the order of the beams."""
        return UntimedScans.from_angles(self.angles[::turn], self.period).turn_times(bearings)


def find_untimed_scanners(
    rig: Rig, recording: Recording, timeline: RecordingTimeline
) -> dict[str, UntimedScanner]:
    """The 2-D scanners whose first message states no times, by name."""
    found = {}
    for name, times in timeline.sensors.items():
        if times.message_type != LaserScan.__name__ or times.duration or not np.isfinite(times.period):
            continue
        try:
            message = next(recording.records([rig.topics[name]])).decode()
        except RecordingError:
            continue
        if isinstance(message, LaserScan) and len(message.angles) > 1:
            found[name] = UntimedScanner(message.angles, times.period)
    return found


def compensate_with_beam_times(
    rig: Rig, captures: CaptureSet, untimed: Mapping[str, UntimedScanner], rng: np.random.Generator
) -> CaptureSet:
    """The captures of a moving board as of :func:`compensate_motion`, with the times of beams that others show."""
    settings = rig.settings.captures.moving_board
    moved = compensate_motion(captures, settings)
    turns = {name: _estimate_turn(rig, moved, name, scanner, rng) for name, scanner in untimed.items()}
    findings = []
    if turning := {name: turn for name, turn in turns.items() if turn}:
        timed = {name: _add_times(captures, name, untimed[name], turn) for name, turn in turning.items()}
        captures = replace(captures, detections={**captures.detections, **timed})
        periods = [untimed[name].period for name in turning]
        findings.append(Finding(describe_turning(turning, periods, "the board is")))
        moved = compensate_motion(captures, settings)
    displacement = {
        name: _measure_displacement(moved, name, untimed[name]) for name, turn in turns.items() if turn is None
    }
    unknown = [name for name, distance in displacement.items() if distance > _MAX_DISPLACEMENT]
    if unknown:
        findings.append(
            Finding(
                f"the scans of {', '.join(unknown)} have no times of beams (time_increment is 0), and the "
                "captures do not show whether all are simultaneous: if not, the board is displaced by up to "
                f"{1e3 * max(displacement[name] for name in unknown):.0f} mm; set time_increment in the drivers, "
                "or let the board rest",
                tuple(unknown),
            )
        )
    return replace(moved, findings=(*moved.findings, *findings))


def _add_times(
    captures: CaptureSet, name: str, scanner: UntimedScanner, turn: int
) -> dict[int, tuple[Detection, ...]]:
    """The detections of a scanner with the times of their beams."""
    return {
        capture: tuple(
            replace(one, times=scanner.measure_times(_list_bearings(one.directions), turn))
            if isinstance(one, Segment)
            else one
            for one in found
        )
        for capture, found in captures.detections[name].items()
    }


def _estimate_turn(
    rig: Rig, captures: CaptureSet, name: str, scanner: UntimedScanner, rng: np.random.Generator
) -> int | None:
    """Whether a scanner turns, from the planes that others measured; None where these do not show it."""
    parts = [
        part
        for other, found in captures.detections.items()
        if any(isinstance(one, BoardCorners | PlanePatch) for of_capture in found.values() for one in of_capture)
        and (part := _linearize(rig, captures, other, name, scanner, rng)) is not None
    ]
    if not parts:
        return None
    rows = [own.reshape(-1, _UNKNOWNS + 1) for own, _, _ in parts]
    shared = np.concatenate([one[:, _UNKNOWNS] for one in rows])
    own_and_shared = np.column_stack([block_diag(*(one[:, :_UNKNOWNS] for one in rows)), shared])
    jacobian = own_and_shared.reshape(-1, 2, own_and_shared.shape[1])
    distances = np.concatenate([one for _, one, _ in parts])
    # Errors of the scanner in one capture are in all pairs.
    _, groups = np.unique(np.concatenate([one for _, _, one in parts]), return_inverse=True)
    solution, stddev = solve_with_grouped_errors(jacobian, distances, groups)
    # In 15 simulated rigs at 15 Hz, estimates scattered by 0.15, and standard deviations were 0.14 to 0.24.
    return decide_turn(float(solution[-1]), float(stddev[-1]))


def _linearize(
    rig: Rig, captures: CaptureSet, other: str, name: str, scanner: UntimedScanner, rng: np.random.Generator
) -> tuple[Array, Array, Array] | None:
    """Derivatives (M, 2, 8), distances (M, 2) of the halves of segments from planes, m, and captures (M,).

    The derivatives are by pose, clock, and s. None where there are too few matches.
    """
    planes, segments = captures.detections[other], captures.detections[name]
    pair = estimate_pair(other, name, planes, segments, rig.board_size, rng, settings=rig.settings.pairwise.board)
    if isinstance(pair, Rejected):
        return None
    rows = []
    for capture, i, j in pair.matches:
        board, segment = planes[capture][i], segments[capture][j]
        assert isinstance(board, BoardCorners | PlanePatch)
        assert isinstance(segment, Segment)
        halves = np.array([half.mean(axis=0) for half in np.array_split(segment.points, 2)])
        places = se3.apply(pair.T_a_b, halves)
        n, d = board.plane[:3], board.plane[3]
        along = (board.twist[:3] + np.cross(board.twist[3:], places)) @ n
        delays = scanner.measure_times(_list_bearings(halves), 1)
        pose = np.column_stack([np.broadcast_to(n, (2, 3)), np.cross(places, n)])
        distances = places @ n + d
        # Inliers alone are those that a wrong time displaces least.
        if np.abs(distances).max() < _MAX_DISTANCE:
            rows.append((np.column_stack([pose, along, along * delays]), distances, capture))
    if len(rows) < _MIN_MATCHES:
        return None
    jacobian, all_distances, of_captures = (np.array(values) for values in zip(*rows, strict=True))
    return jacobian, all_distances, of_captures


def _measure_displacement(captures: CaptureSet, name: str, scanner: UntimedScanner) -> float:
    """By which the board moves while a scanner turns through the bearings that it measured it at, m."""
    found = [one for some in captures.detections[name].values() for one in some if isinstance(one, Segment)]
    if not found:
        return 0.0
    bearings = _list_bearings(np.array([one.center for one in found]))
    speeds = [np.linalg.norm(one.twist[:3] + np.cross(one.twist[3:], one.center)) for one in found]
    return float(np.median(speeds) * np.ptp(scanner.measure_times(bearings, 1)))


def _list_bearings(points: Array) -> Array:
    """(N,) of points or directions (N, 3), rad."""
    return np.asarray(np.arctan2(points[:, 1], points[:, 0]))
