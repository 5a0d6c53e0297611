"""A live session of which poses are computed from its growing recording, as often as one process allows."""

import math
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path

from calgraph.config import Rig
from calgraph.errors import RecordingError, Rejected
from calgraph.live.capture_finder import name_sensors
from calgraph.live.live_timeline import LiveTimeline
from calgraph.live.session import S, Session, SessionPools
from calgraph.live.source import LiveMessage
from calgraph.live.state import Phase, SensorState

# Maximum share of the time in which solutions are computed.
_MAX_LOAD = 0.5
# Minimum time from the end of a solution to the next, s, so that there is something new.
PAUSE = 2.0


class RecordedSession(Session[S]):
    """Everything that is shown of poses is computed from the recording, so that sessions that are resumed go on.

    Args:
        rig: as its user wrote it.
        source: name of the source.
        pools: where it computes: ``solving``.
        recording: path of the recording that receives the messages.
        print_line: takes a line on poses that are all within tolerance.
        clock: time by which the load is limited, s.
    """

    solve: Callable[[Rig, Path, S | None], S | None]
    """Calibrates from the rig, the path of the recording, and the last solution, if there is one; None without
    messages. Defined at module level."""

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
        super().__init__(rig, source, pools, print_line)
        self._recording, self._clock = recording, clock
        self.timeline = LiveTimeline(rig)
        self._began, self._next = 0.0, -math.inf
        """When the last solution began and when the next may, s."""

    def feed(self, message: LiveMessage) -> None:
        """Takes a message that has been recorded; what it measured is read by another process."""
        self.timeline.note_arrival(message.arrival / 1e9)
        for name, topic in self.rig.topics.items():
            if topic == message.channel.topic:
                try:
                    self.timeline.add(name, message.read(self._source, self.rig.settings.limits))
                except RecordingError as error:
                    self.timeline.sensors[name].note_malformed(str(error))
        self.advance()

    def advance(self) -> None:
        """Calibrates if the process is free, the load allows it, and there is something new."""
        if self.timeline.start is None or not self._solver.idle or self._clock() < self._next:
            return
        if not self.is_due():
            return
        self._began = self._clock()
        self._solver.run(self.take, self.solve, self.rig, self._recording, self.solution)

    @abstractmethod
    def is_due(self) -> bool:
        """Whether there is something to calibrate from that the last solution did not have."""

    def take(self, solution: S | Rejected | None) -> None:
        """See :meth:`Session.take`."""
        # The process rests as long as it worked, where half of the time is allowed.
        now = self._clock()
        self._next = now + max(PAUSE, (now - self._began) * (1 / _MAX_LOAD - 1))
        super().take(solution)

    def find_unheard(self) -> tuple[Phase, str] | None:
        """The phase and its headline while a sensor sends nothing."""
        if unheard := [name for name in self.rig.sensors if self.timeline.age(name) is None]:
            return "connecting", f"Waiting for messages of {name_sensors(unheard)}"
        if silent := [name for name in self.rig.sensors if self.timeline.is_silent(name)]:
            return "measuring", f"{name_sensors(silent)}: no messages any more"
        return None

    def list_sensor_states(self) -> Iterator[SensorState]:
        """Sensors by their messages; see :meth:`Session.list_sensor_states`."""
        problems = self.timeline.find_problems()
        for name, spec in self.rig.sensors.items():
            times, solved = self.timeline.sensors[name], self.find_solved(name)
            yield SensorState(
                name=name,
                kind=spec.kind,
                rate=times.rate,
                problem="; ".join(filter(None, (times.describe_malformed(), problems.get(name)))),
                reason=solved.reason if solved else "",
                captures=solved.tracks if solved else 0,
            )
