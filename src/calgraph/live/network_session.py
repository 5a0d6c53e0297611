"""A live session of a network: from its messages to poses again and again, and what people should do."""

import asyncio
import math
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from calgraph.config import Rig
from calgraph.errors import RecordingError
from calgraph.io.termination import add_cleanup, remove_cleanup
from calgraph.live.floor_plan import draw_floor_plan
from calgraph.live.job_queue import JobQueue
from calgraph.live.live_timeline import LiveTimeline
from calgraph.live.network_forecast import Forecast
from calgraph.live.network_solution import LiveNetworkSolution, solve_recording
from calgraph.live.network_state import PAUSE, ScannerMessages, describe_network_session
from calgraph.live.record_reader import RecordReader
from calgraph.live.rig_session import SessionPools
from calgraph.live.source import LiveMessage
from calgraph.live.state import Command, SessionState

Solve = Callable[[Rig, Path, Path, LiveNetworkSolution | None], LiveNetworkSolution | None]
"""Calibrates from a recording; defined at module level. See :func:`solve_recording`."""


# Maximum share of the time in which solutions are computed.
_MAX_LOAD = 0.5


class NetworkSession:
    """Calibrates a network of scanners from its growing recording, as often as one process allows.

    All calls are made in one thread, and none blocks. Everything that is shown besides rates is computed from the
    recording, so that a session that is resumed needs nothing else.

    Args:
        rig: the network, as its user wrote it.
        source: name of the source.
        pools: where it computes: ``solving``.
        recording: path of the recording that receives the messages.
        solve: calibrates.
        clock: time by which the load is limited, s.
    """

    def __init__(
        self,
        rig: Rig,
        source: str,
        pools: SessionPools,
        recording: Path,
        *,
        solve: Solve = solve_recording,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.rig = rig
        self._source, self._recording, self._solve, self._clock = source, recording, solve, clock
        self._reader = RecordReader(source, rig.settings.limits)
        self._sensor_of = {topic: name for name, topic in rig.topics.items()}
        self.timeline = LiveTimeline(rig.sensors)
        self._messages = {name: ScannerMessages() for name in rig.sensors}
        self._queue = JobQueue(pools.solving, 1, lambda function: pools.post(lambda: self._handle(function)))
        self._folder = TemporaryDirectory(prefix="calgraph-tracks-", ignore_cleanup_errors=True)
        add_cleanup(self, self._folder.cleanup)
        self.solution: LiveNetworkSolution | None = None
        """The last one; None before the first."""
        self._forecast = Forecast(rig.settings.live.network)
        self._floor_plan = ""
        self._began, self._next = 0.0, -math.inf
        """When the last solution began and when the next may, s."""
        self._problem = ""
        self._state: SessionState | None = None
        self._shown_at = -math.inf
        self._change = asyncio.Event()

    def feed(self, message: LiveMessage) -> None:
        """Takes a message that has been recorded; scans are read from the recording, by another process."""
        arrival = message.arrival / 1e9
        self.timeline.note_arrival(arrival)
        name = self._sensor_of.get(message.channel.topic)
        if name is not None:
            try:
                record = self._reader.read(message)
                self._messages[name].delays.append(record.stamp - arrival)
                self.timeline.add(name, record)
            except RecordingError as error:
                self._messages[name].note_malformed(str(error))
                self._note_change()
        if self.timeline.latest_arrival - self._shown_at >= 1 / self.rig.settings.live.view.rate:
            self._shown_at = self.timeline.latest_arrival
            self._note_change()
        self._start_solving()

    def command(self, command: Command) -> None:
        """Nothing is triggered or discarded; ``finish`` concerns who owns the session."""

    def state(self) -> SessionState:
        """The session now, without what concerns source and recorder; another object after each change."""
        if self._state is None:
            self._state = describe_network_session(
                self.rig,
                self._source,
                self.timeline,
                self._messages,
                self.solution,
                self._forecast,
                self._floor_plan,
                self._problem,
            )
        return self._state

    async def wait_for_change(self, state: SessionState) -> None:
        """Returns as soon as :meth:`state` is another object than ``state``."""
        while self._state is state:
            self._change.clear()
            await self._change.wait()

    def picture(self, sensor: str) -> bytes | None:
        """None: the floor plan shows all scanners."""

    def scene(self) -> bytes | None:
        """None: networks are shown as a floor plan."""

    @property
    def minutes_left(self) -> float | None:
        """Until all scanners with a pose are within tolerance; None if that is unknown."""
        return self._forecast.minutes_left()

    @property
    def busy(self) -> bool:
        """Whether another process works for the session."""
        return self._queue.running > 0

    @property
    def lag(self) -> float:
        """0: what is solved is read from the recording, and nothing is skipped."""
        return 0.0

    def close(self) -> None:
        """Ends the session: results of calls under way are ignored."""
        self._queue.closed = True
        remove_cleanup(self)
        self._folder.cleanup()

    def _start_solving(self) -> None:
        """Calibrates if the process is free, the load allows it, and there is something new."""
        settings, begin = self.rig.settings.live.network, self.timeline.start
        if begin is None or not self._queue.idle or self._clock() < self._next:
            return
        until = begin + settings.first if self.solution is None else self.solution.end + PAUSE
        if self.timeline.latest_arrival < until:
            return
        self._began = self._clock()
        self._queue.run(
            self._solve, self.rig, self._recording, Path(self._folder.name), self.solution,
            done=self._set_solution, failed=self._fail_solving,
        )  # fmt: skip

    def _handle(self, function: Callable[[], None]) -> None:
        function()
        self._start_solving()

    def _set_next(self) -> None:
        """The process rests as long as it worked, where half of the time is allowed."""
        now = self._clock()
        self._next = now + max(PAUSE, (now - self._began) * (1 / _MAX_LOAD - 1))

    def _set_solution(self, solution: LiveNetworkSolution | None) -> None:
        self._set_next()
        if solution is not None:
            self.solution, self._problem = solution, ""
            self._forecast.add(solution)
            self._floor_plan = draw_floor_plan(solution, self.rig.root, self.rig.tolerance)
        self._note_change()

    def _fail_solving(self, error: BaseException) -> None:
        self._set_next()
        self._problem = f"No poses from the recording until now: {error}"
        self._note_change()

    def _note_change(self) -> None:
        self._state = None
        self._change.set()
