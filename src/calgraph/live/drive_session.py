"""A live session of a robot that drives: how it has moved, what to drive next, and poses of what was recorded."""

import math
import time
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from calgraph.config import Rig
from calgraph.drive.options import DriveOptions
from calgraph.drive.pipeline import calibrate_drive
from calgraph.errors import CalgraphError, Rejected
from calgraph.live.capture_finder import name_sensors
from calgraph.live.drive_motion import DriveMotion, list_needs, measure_motions, select_measuring
from calgraph.live.recorded_files import open_growing
from calgraph.live.recorded_session import RecordedSession
from calgraph.live.sensor_solution import Solution, describe_sensors
from calgraph.live.session import ALL_DONE, SessionPools
from calgraph.live.source import LiveMessage
from calgraph.live.state import Action, Advice, Need, Phase, SceneState, SessionState
from calgraph.result import Calibration
from calgraph.result.finding import split_clauses

# Time of which odometry gets the messages, s: trajectories of 5 Hz have the poses that they need; and how much of
# it is new, so that a LiDAR of 16 rings takes a quarter of a core. Before the first time there is no motion.
_WINDOW, _FRESH, _FIRST = 12.0, 3.0, 6.0
# Time after which a recording is calibrated again by itself, s: a third more than the least.
_AGAIN = 10.0


@dataclass(frozen=True, eq=False)
class LiveDriveSolution(Solution):
    """The calibration of a drive from what was recorded until some time."""

    end: float
    """Arrival up to which messages were used, s."""
    problem: str = ""
    """Why there is no calibration, if there is none."""


def solve_drive(rig: Rig, path: Path, last: LiveDriveSolution | None) -> LiveDriveSolution | None:  # noqa: ARG001
    """Calibrates a drive from its recording until now; None as long as that has no message."""
    calibration: Calibration | None = None
    problem = ""
    with open_growing(path, rig.settings.limits) as recording:
        if recording is None:
            return None
        try:
            calibration = calibrate_drive(rig, recording, DriveOptions())
        except CalgraphError as error:
            problem = str(error)
        return LiveDriveSolution(describe_sensors(rig, calibration), recording.end, problem)


class DriveSession(RecordedSession[LiveDriveSolution]):
    """Follows the robot by the odometry of one sensor, and calibrates when it has moved enough, or on demand.

    ``pools.analysis`` measures motion; see :class:`RecordedSession` for the rest.
    """

    solve = staticmethod(solve_drive)

    def __init__(
        self,
        rig: Rig,
        source: str,
        pools: SessionPools,
        recording: Path,
        print_line: Callable[[str], object],
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(rig, source, pools, recording, print_line, clock=clock)
        self._measuring = select_measuring(rig)
        """The sensor that motion is measured by."""
        self._messages: list[LiveMessage] = []
        """Its last messages."""
        self._measured = -math.inf
        """Arrival of the last message that odometry has got, s."""
        self._motion = DriveMotion()
        self._unknown = ""
        """Why nothing is known of the last motion; empty if it is."""
        self._wanted = False

    def feed(self, message: LiveMessage) -> None:
        """Takes a message that has been recorded."""
        if self._measuring and message.channel.topic == self.rig.topics[self._measuring]:
            self._messages.append(message)
        super().feed(message)

    def act(self, action: Action) -> None:
        """``trigger`` calibrates what was recorded until now."""
        if action == "trigger":
            self._wanted, self._next = True, -math.inf
            self.advance()

    @property
    def lag(self) -> float:  # type: ignore[override]
        """Time since the messages of which motion is being measured, s."""
        return self.timeline.latest_arrival - self._measured if self._queue.running else 0.0

    def advance(self) -> None:
        """Measures the motion of the last seconds, and calibrates."""
        if self._messages and self._queue.idle:
            arrivals = [message.arrival / 1e9 for message in self._messages]
            last = arrivals[-1]
            if last >= max(self._measured + _FRESH, arrivals[0] + _FIRST):
                self._measured = last
                del self._messages[: bisect_left(arrivals, last - _WINDOW)]
                after = self._motion.starts[-1] if len(self._motion.starts) else -math.inf
                self._queue.run(
                    self._set_motion, measure_motions, self.rig, self._measuring, self._source,
                    tuple(self._messages), after,
                )  # fmt: skip
        super().advance()

    def _set_motion(self, found: DriveMotion | Rejected) -> None:
        self._unknown = found.reason if isinstance(found, Rejected) else ""
        if isinstance(found, DriveMotion):
            self._motion = self._motion.joined(found)

    def is_due(self) -> bool:
        """See :meth:`RecordedSession.is_due`."""
        if self._wanted:
            self._wanted = False
            return True
        if self.solution is None:
            return all(need.optional or need.done for need in self._list_needs())
        return not self.done and self.timeline.latest_arrival >= self.solution.end + _AGAIN

    def describe(self) -> SessionState:
        """The session now; see :meth:`Session.describe`."""
        solution, needs = self.solution, self._list_needs()
        lacking = [need.advice for need in needs if not need.done]
        phase, headline = self.find_unheard() or self._describe_phase(lacking)
        stated = [one.reason for one in solution.sensors if one.reason] if solution else []
        reasons = [clause for reason in stated for clause in split_clauses(reason)]
        advice = "; ".join(dict.fromkeys([*lacking, *reasons]))
        unknown = f"Turns and way are not known: {self._measuring}: {self._unknown}" if self._unknown else ""
        return SessionState(
            "drive",
            phase,
            headline,
            advice=Advice(advice) if advice and not self.done else None,
            notices=(unknown,) if unknown else (),
            scene=SceneState(solution.posed) if solution and solution.posed else None,
            needs=needs,
        )

    def _list_needs(self) -> tuple[Need, ...]:
        seconds = self.timeline.latest_arrival - (self.timeline.start or 0.0)
        return list_needs(self.rig, seconds, self._motion, self._measuring)

    def _describe_phase(self, lacking: list[str]) -> tuple[Phase, str]:
        solution = self.solution
        if self.done:
            return "ready", ALL_DONE
        if not self._solver.idle:
            return "waiting", "What was recorded is being calibrated: drive on"
        if solution is None:
            return "measuring", _capitalize(lacking[0] if lacking else "drive on")
        if solution.problem:
            return "measuring", f"No poses yet: {solution.problem}"
        open_ = [one.name for one in solution.sensors if one.grade != "good"]
        return "measuring", f"{_capitalize(lacking[0] if lacking else 'drive on')}, for {name_sensors(open_)}"


def _capitalize(text: str) -> str:
    return text[:1].upper() + text[1:]
