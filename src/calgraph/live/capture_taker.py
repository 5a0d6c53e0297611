"""Captures of a live session: triggered, searched for the board, and taken or refused with the reason."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

from calgraph.boards.detections import DetectionResult
from calgraph.config import Rig
from calgraph.errors import Rejected
from calgraph.live.analysis_jobs import Decoder, DetectorInputs, detect_board
from calgraph.live.capture_finder import Candidate, CaptureFinder, Waiting, name_sensors
from calgraph.live.job_queue import JobQueue
from calgraph.live.live_captures import LiveCapture, explain_rejection, find_same_pose, has_board
from calgraph.live.message_analysis import MessageAnalysis
from calgraph.live.state import CaptureEvent
from calgraph.rig.captures.holds import Hold, limit_messages

# Two sensors that detect the board determine something.
_MIN_SENSORS = 2


@dataclass(frozen=True)
class _Request:
    """A capture that the operator wants."""

    arrival: float
    """When, by the arrivals of messages, s."""
    forced: float | None = None
    """Time at which it begins although the board moves, s."""


@dataclass
class _Search:
    """The detections of a candidate that are being computed."""

    candidate: Candidate
    hold: Hold
    arrival: float
    """Of the last message before it, s."""
    requested: bool
    waiting: list[tuple[DetectorInputs, Sequence[Decoder]]] = field(default_factory=list)
    results: dict[str, DetectionResult] = field(default_factory=dict)


class CaptureTaker:
    """Takes captures: as soon as the board rests after a request, or whenever it rests in a new pose.

    Args:
        rig: of the session.
        analysis: of its messages.
        write_trigger: records the trigger of a capture that begins at a stamp, s.
        print_line: takes a line on each capture that is taken or refused.
    """

    def __init__(
        self,
        rig: Rig,
        analysis: MessageAnalysis,
        write_trigger: Callable[[float], None],
        print_line: Callable[[str], object],
    ) -> None:
        self._rig, self._analysis, self._write_trigger, self._print_line = rig, analysis, write_trigger, print_line
        self._settings = rig.settings.live.capture
        self.finder = CaptureFinder(rig, analysis.timeline, analysis.ring, analysis.rests)
        self.captures: list[LiveCapture] = []
        self.event = CaptureEvent()
        self.automatic = True
        self.waiting = Waiting("connecting")
        """What the next capture waits for."""
        self._request: _Request | None = None
        self._search: _Search | None = None
        self._judged_rest: float | None = None

    @property
    def requested(self) -> bool:
        """Whether the operator waits for a capture."""
        return self._request is not None

    @property
    def searching(self) -> bool:
        """Whether the board is searched for in a capture."""
        return self._search is not None

    @property
    def lag(self) -> float:
        """Time by which the search of the candidate is behind the messages, s; 0 without one."""
        return self._analysis.timeline.latest_arrival - self._search.arrival if self._search else 0.0

    def request(self) -> None:
        """Takes a capture as soon as the board rests; wanted a second time, without waiting for that."""
        if self._analysis.background_left:
            self._announce("No capture yet: the scanners learn the room", taken=False)
            return
        if self._search:
            self._search.requested = True
            return
        arrival = self._analysis.timeline.latest_arrival
        if self._request and self._request.forced is None:
            self._request = _Request(arrival, self.finder.now())
        elif not self._request:
            self._request = _Request(arrival, None if self.finder.fast_sensors() else self.finder.now())
        self.advance()

    def advance(self) -> None:
        """Begins to search a capture that can be taken now."""
        if self._search or self._analysis.background_left:
            return
        request = self._request
        found = self.finder.find(request.forced) if request else self.finder.find(judged=self._judged_rest)
        if isinstance(found, Candidate):
            if request or self.automatic:
                self._begin(found)
            else:
                self.waiting = Waiting("ready")
            return
        self.waiting = found
        if request is None:
            return
        waited = self._analysis.timeline.latest_arrival - request.arrival
        if found.problem or waited > self._settings.timeout:
            self._request = None
            self._announce(f"No capture: {_explain_waiting(found)}", taken=False)

    def _begin(self, candidate: Candidate) -> None:
        """Has the messages of a candidate searched, once the detectors of all sensors are ready."""
        detectors = self._analysis.detectors
        if not all(detectors.is_ready(name) for name in self._rig.sensors):
            return
        (hold,) = limit_messages([candidate.hold], self._rig)
        search = _Search(candidate, hold, self._analysis.timeline.latest_arrival, self._request is not None)
        for name in self._rig.sensors:
            records = self._analysis.ring.select(name, hold.stamps[name].tolist())
            if records is None:
                search.results[name] = Rejected("its messages of this capture are no longer in memory")
            else:
                search.waiting.append((detectors.state_inputs(name), [record.decode for record in records]))
        self._request, self._search = None, search
        self.waiting = Waiting("measuring")
        self._judge_if_complete(search)

    def start_job(self, queue: JobQueue) -> bool:
        """Starts the next search of the candidate; whether there was any."""
        search = self._search
        if search is None or not search.waiting:
            return False
        inputs, decoders = search.waiting.pop(0)
        queue.run(partial(self._add_result, search, inputs.name), detect_board, inputs, decoders)
        return True

    def _add_result(self, search: _Search, name: str, found: DetectionResult) -> None:
        search.results[name] = found
        self._judge_if_complete(search)

    def _judge_if_complete(self, search: _Search) -> None:
        if len(search.results) == len(self._rig.sensors) and search is self._search:
            self._search = None
            self._judge(search)

    def _judge(self, search: _Search) -> None:
        """Takes the capture, or states why not."""
        results = {name: search.results[name] for name in self._rig.sensors}
        capture = LiveCapture(search.hold, results)
        self._judged_rest = search.candidate.rest
        if len(capture.sensors) < _MIN_SENSORS:
            # Without a request, a board that is out of all views is no event.
            if search.requested or capture.sensors:
                self._announce(f"No capture: {self._explain_missing(results)}", taken=False)
            return
        if not search.requested:
            same = find_same_pose(results, self.captures, self._settings)
            if same is not None:
                # A board that is held longer than a capture takes is no event.
                if same != len(self.captures) - 1:
                    self._announce(f"No capture: the pose is that of capture {same + 1}", taken=False)
                return
        self._write_trigger(search.hold.start)
        self.finder.earliest = search.candidate.hold.end
        self.captures.append(capture)
        missing = self._explain_missing(results)
        text = f"Capture {len(self.captures)}: {', '.join(capture.sensors)}"
        self._announce(f"{text}; {missing}" if missing else text, taken=True)

    def _explain_missing(self, results: Mapping[str, DetectionResult]) -> str:
        """Which sensors did not detect the board, and why."""
        by_reason: dict[str, list[str]] = {}
        for name, found in results.items():
            if isinstance(found, Rejected) and not has_board(found):
                by_reason.setdefault(explain_rejection(found.reason), []).append(name)
        return "; ".join(
            f"{name_sensors(names)} {'do' if len(names) > 1 else 'does'} not detect the board ({reason})"
            for reason, names in by_reason.items()
        )

    def _announce(self, text: str, *, taken: bool) -> None:
        self.event = CaptureEvent(self.event.number + 1, taken, text)
        self._print_line(text)

    def restore(self, captures: Sequence[LiveCapture], latest: float) -> None:
        """Continues with captures of before; none begins before ``latest``, s."""
        self.captures = list(captures)
        self.finder.earliest = latest

    def discard(self) -> LiveCapture | None:
        """Leaves out the last capture; it is returned."""
        if not self.captures:
            return None
        number = len(self.captures)
        capture = self.captures.pop()
        self._announce(f"Capture {number} is left out", taken=False)
        return capture


def _explain_waiting(waiting: Waiting) -> str:
    names = name_sensors(waiting.sensors)
    if waiting.problem:
        return waiting.problem
    if waiting.phase == "measuring":
        return f"{names} did not measure the board at rest" if names else "the board did not rest long enough"
    return f"still moving ({names})" if names else "still moving"
