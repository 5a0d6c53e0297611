"""A live session of a rig or a network as its page shows and commands it."""

import asyncio
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Generic, TypeVar

from calgraph.config import Rig
from calgraph.errors import Rejected
from calgraph.live.job_queue import JobQueue, Post
from calgraph.live.sensor_solution import SensorSolution, Solution
from calgraph.live.source import LiveMessage, Notice
from calgraph.live.state import Action, Phase, RecorderState, SensorState, SessionState

ALL_DONE = "All sensors are within tolerance: finish"
"""What an operator reads who has done enough."""
# More do not fit on a phone.
_SHOWN_NOTICES = 5


@dataclass(frozen=True)
class SessionPools:
    """Where a session computes."""

    analysis: Executor
    """Detects; forked before threads start, see :func:`calgraph.parallel.processes.worker_pool`."""
    analysis_processes: int
    """Number of its processes."""
    solving: Executor
    """Solves, one solution at a time."""
    post: Post
    """Has results handled in the thread of the session: ``loop.call_soon_threadsafe``."""


S = TypeVar("S", bound=Solution)


class Session(ABC, Generic[S]):
    """Takes messages as they are recorded; what the page shows of them, and where its commands go.

    All calls are made in one asyncio loop, and none blocks.

    Args:
        rig: of the recording.
        source: name of the source.
        pools: where it computes.
        print_line: takes a line on what has happened.
    """

    lag = 0.0
    """Time by which the processes that detect are behind the messages, s; 0 as soon as they wait for more."""

    def __init__(self, rig: Rig, source: str, pools: SessionPools, print_line: Callable[[str], object]) -> None:
        self.rig = rig
        self.triggers: deque[LiveMessage] = deque()
        """That are to be recorded, each before the messages that follow it."""
        self.finish_wanted = asyncio.Event()
        """Set when the operator ends the session."""
        self._source, self._print_line = source, print_line
        self._solver = JobQueue(pools.solving, 1, pools.post, self.advance)
        self._queue = JobQueue(pools.analysis, pools.analysis_processes, pools.post, self.advance)
        self._queues = (self._solver, self._queue)
        self.solution: S | None = None
        """The last one; None before the first."""
        self._problem = ""
        """Why there are no poses from what was recorded last; empty if there are."""
        self._recorded: Callable[[], RecorderState] = RecorderState
        self._notices: deque[str] = deque(maxlen=_SHOWN_NOTICES)
        self._connected = False
        self._lost = self._gaps = 0
        self._end: tuple[Phase, str, bool] | None = None
        self._report: Path | None = None

    @abstractmethod
    def feed(self, message: LiveMessage) -> None:
        """Takes a message that has been recorded; the work is left to other processes."""

    @abstractmethod
    def advance(self) -> None:
        """Has what can be computed now computed by other processes."""

    @abstractmethod
    def describe(self) -> SessionState:
        """The session now, without what all sessions have.

        :meth:`state` adds source, root, sensors, tolerances and done, and what concerns connection, recorder and
        end.
        """

    @abstractmethod
    def list_sensor_states(self) -> Iterator[SensorState]:
        """The sensors in the order of rig.yaml, without their poses."""

    @property
    def done(self) -> bool:
        """Whether all sensors have good poses."""
        return self.solution is not None and self.solution.done

    def find_solved(self, name: str) -> SensorSolution | None:
        """What the last solution has of a sensor."""
        return next((one for one in self.solution.sensors if one.name == name), None) if self.solution else None

    def take(self, solution: S | Rejected | None) -> None:
        """Takes a solution, or why there is none; None where there was nothing to solve for."""
        if isinstance(solution, Rejected):
            self._problem = f"No poses from what was recorded until now: {solution.reason}"
        elif solution is not None:
            if solution.done and not self.done:
                self._print_line(ALL_DONE)
            self.solution, self._problem = solution, ""

    def act(self, action: Action) -> None:
        """Does what the operator wants; ``finish`` concerns who owns the session."""

    def picture(self, sensor: str) -> bytes | None:  # noqa: ARG002
        """The view of a sensor with the board drawn in, a JPEG image; None before the first."""
        return None

    @property
    def busy(self) -> bool:
        """Whether other processes work for the session."""
        return any(queue.running for queue in self._queues)

    def close(self) -> None:
        """Ends the session: results of calls under way are ignored."""
        for queue in self._queues:
            queue.closed = True

    def show_recorder(self, recorded: Callable[[], RecorderState]) -> None:
        """From now on shows what is recorded."""
        self._recorded = recorded

    def note(self, notice: Notice) -> None:
        """Shows what happened to the connection."""
        if notice.kind == "disconnected" and self._connected:
            self._gaps += 1
        if notice.kind in ("connected", "disconnected", "ended"):
            self._connected = notice.kind == "connected"
        if notice.kind == "lost":
            self._lost += notice.count
        self._notices.appendleft(notice.text)
        self._print_line(notice.text)

    def show_end(self, phase: Phase, headline: str, report: Path | None = None, *, done: bool = False) -> None:
        """From now on shows a phase of the end of the session, in place of those of the captures.

        Args:
            phase: ``finishing``, ``finished`` or ``failed``.
            headline: one sentence.
            report: of the calibration, if there is one.
            done: whether all poses are good.
        """
        self._end, self._report = (phase, headline, done), report

    def state(self) -> SessionState:
        """The session now."""
        shown, rig = self.describe(), self.rig
        sensors = (one.with_pose(self.find_solved(one.name), rig.root) for one in self.list_sensor_states())
        killed = next((queue.problem for queue in self._queues if queue.problem), "")
        headline = f"Only recording goes on: {killed}" if killed else self._problem or shown.headline
        phase, headline, done = self._end or (shown.phase, headline, self.done)
        return replace(
            shown,
            phase=phase,
            headline=headline,
            done=done,
            source=self._source,
            root=rig.root,
            sensors=tuple(sensors),
            tolerance_mm=1000 * rig.tolerance.translation,
            tolerance_degrees=rig.tolerance.rotation,
            connected=self._connected,
            notices=(*self._notices, *shown.notices)[:_SHOWN_NOTICES],
            recorder=replace(self._recorded(), lost=self._lost, gaps=self._gaps),
            report=self._report is not None,
        )

    def report(self) -> Path | None:
        """The report of the calibration; None as long as there is none."""
        return self._report

    def command(self, action: Action) -> None:
        """Does what the operator wants, until the session ends."""
        if self._end:
            return
        if action == "finish":
            self.finish_wanted.set()
        else:
            self.act(action)
