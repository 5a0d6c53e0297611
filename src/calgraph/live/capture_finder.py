"""When a capture can be taken: the board rests, and every sensor has measured it."""

from collections.abc import Sequence
from dataclasses import dataclass

from calgraph.config import Rig
from calgraph.errors import CalibrationError
from calgraph.live.live_timeline import LiveTimeline
from calgraph.live.message_ring import MessageRing
from calgraph.live.motion import Rest, RestMonitor
from calgraph.live.state import Phase
from calgraph.rig.captures.holds import Hold, find_holds
from calgraph.rig.captures.timeline import MAX_MOTION_PERIOD

# Stamps as floating-point numbers are apart by 0.2 µs: captures do not share a message.
_GAP = 1e-6


@dataclass(frozen=True, eq=False)
class Candidate:
    """A capture that could be taken."""

    hold: Hold
    """As :func:`find_holds` finds it of a trigger at its start, with the messages to search."""
    rest: float | None
    """Start of the rest that it lies in, s; None if the operator did not want to wait for one."""


@dataclass(frozen=True)
class Waiting:
    """Why no capture can be taken yet."""

    phase: Phase
    sensors: tuple[str, ...] = ()
    """Those that are waited for: moving, or still measuring."""
    problem: str = ""
    """Why none can be taken before someone corrects it."""


# Time from the last motion to the start of a capture, s: 0.1 s before the end of a move by 1 m the board is still
# 10 mm from its place, and moves no more than noise.
_SETTLE = 0.2
# Maximum number of messages of a sensor per second whose change is measured, 1/s: a rest is noticed within 0.1 s,
# and fast cameras leave time for the detection.
MAX_RATE = 10.0


class CaptureFinder:
    """Finds times at which a trigger gives a capture; the same as later in the recording.

    Args:
        rig: of the session, with its trigger and background window.
        timeline: of the messages so far.
        ring: the messages that are in memory.
        rests: rest and motion of the views.
    """

    def __init__(self, rig: Rig, timeline: LiveTimeline, ring: MessageRing, rests: RestMonitor) -> None:
        self._rig, self._timeline, self._ring, self._rests = rig, timeline, ring, rests
        self.earliest = float("-inf")
        """No capture begins before it: the end of the last one, s."""

    def fast_sensors(self) -> list[str]:
        """Those whose messages show motion."""
        periods = {name: self._timeline.sensors[name].period for name in self._rig.sensors}
        return [name for name, period in periods.items() if period <= MAX_MOTION_PERIOD]

    def now(self) -> float:
        """After the stamps of all measurements so far, s."""
        stamps = [times.latest for times in self._timeline.sensors.values()]
        return max((stamp for stamp in stamps if stamp is not None), default=0.0) + _GAP

    def find(self, forced: float | None = None, judged: float | None = None) -> Candidate | Waiting:
        """The capture that can be taken now.

        Args:
            forced: a time at which it begins in any case, s; else it lies in the rest under way.
            judged: start of a rest in which none is wanted, s.
        """
        problems = self._timeline.find_problems()
        if problems:
            text = "; ".join(f"{name} {problem}" for name, problem in problems.items())
            return Waiting("ready", problem=text)
        fast = self.fast_sensors()
        rest = None if forced is not None else self._rests.find_rest(fast)
        if forced is None and rest is None:
            return Waiting("waiting", tuple(name for name in fast if self._rests.is_moving(name)))
        if rest is not None and rest.start == judged:
            return Waiting("ready")
        start = self._choose_start(forced if rest is None else rest.start + _SETTLE)
        measuring = [
            name for name in self._rig.sensors if len(self._timeline.sensors[name].stamps_from(start)) < 2
        ]
        hold = None if measuring else self._find_hold(start)
        if hold is not None:
            measuring = self._find_unfinished(hold, rest)
        if hold is None or measuring:
            return Waiting("measuring", tuple(measuring))
        return Candidate(hold, rest.start if rest else None)

    def _choose_start(self, start: float | None) -> float:
        """The first time, s, at which a capture may begin, as a header states it: in nanoseconds."""
        begin, window = self._timeline.start or 0.0, self._rig.capture.background
        after_background = begin + window[1] if window else float("-inf")
        # Windows are compared with stamps, as in the recording: a clock that is late does not reach its end.
        if after_background > self.now():
            after_background = float("-inf")
        first = max(start or 0.0, self.earliest + _GAP, self._ring.begin + _GAP, after_background + _GAP)
        return round(first * 1e9) / 1e9

    def _find_hold(self, start: float) -> Hold | None:
        timeline = self._timeline.snapshot([start], start)
        try:
            (hold,) = find_holds(timeline, self._rig.capture, self._rig.settings.captures)
        except CalibrationError:  # in a window without captures
            return None
        return hold

    def _find_unfinished(self, hold: Hold, rest: Rest | None) -> list[str]:
        """Sensors of which messages of the hold may still come, or may still show motion."""
        unfinished = [
            name
            for name, times in self._timeline.sensors.items()
            if (times.latest or 0.0) + times.duration < hold.end - _GAP
        ]
        if rest is None:
            return unfinished
        end = max(hold.end, rest.start + self._rig.settings.captures.min_hold)
        for name, measured in rest.measured.items():
            times = self._timeline.sensors[name]
            stamps = times.stamps_from(hold.start)
            # Of fast sensors some messages are not measured.
            skipped = 1 / MAX_RATE if times.period < 1 / MAX_RATE else 0.0
            last = stamps[stamps <= end][-1:]
            if (stamps[-1] < end - times.period or measured < last - skipped) and name not in unfinished:
                unfinished.append(name)
        return unfinished


def name_sensors(names: Sequence[str]) -> str:
    """Names in a sentence."""
    return " and ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else "".join(names)
