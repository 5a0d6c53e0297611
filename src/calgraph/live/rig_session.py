"""A live session of a rig: from its messages to captures, poses, and the state that the operator is shown."""

from collections.abc import Callable, Iterator

import numpy as np

from calgraph.boards.detections import DetectionResult
from calgraph.config import Intrinsics, Rig
from calgraph.errors import CalibrationError, Rejected
from calgraph.live.analysis_jobs import NO_INTRINSICS
from calgraph.live.capture_finder import name_sensors
from calgraph.live.capture_taker import CaptureTaker
from calgraph.live.live_captures import LiveCapture, collect_live_captures, count_coverage
from calgraph.live.live_rig import TRIGGER_TOPIC, make_trigger, prepare_live_rig
from calgraph.live.message_analysis import MessageAnalysis
from calgraph.live.replay import list_messages
from calgraph.live.rig_solution import LiveSolution
from calgraph.live.session import ALL_DONE, Session, SessionPools
from calgraph.live.source import LiveMessage
from calgraph.live.state import Action, Phase, SensorState, SessionState
from calgraph.parallel.engine import THIS_PROCESS, Engine
from calgraph.parallel.processes import available_cores
from calgraph.recording import Recording, correct_stamps
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.captures.holds import find_holds, limit_messages
from calgraph.rig.captures.sensor_detection import DetectionMethod, detect_by_sensors
from calgraph.rig.captures.timeline import RecordingTimeline
from calgraph.sensors.kinds import KINDS

Solve = Callable[[Rig, CaptureSet, LiveSolution | None], LiveSolution]
"""Computes the poses from the captures until now and the last solution; defined at module level."""


def count_analysis_processes(rig: Rig) -> int:
    """The number of processes that detect on this machine: one core is left to the recorder and the page."""
    return max(1, min(available_cores() - 1, rig.settings.live.analysis_processes))


class RigSession(Session[LiveSolution]):
    """Detects the board in live messages, takes captures, and calibrates after each of them.

    Captures are those that ``calgraph calibrate`` finds in the
    recording of the same messages and triggers with the rig :attr:`rig`.

    Args:
        rig: as its user wrote it.
        source: name of the source.
        pools: where it computes.
        solve: computes poses; none are computed if left out.
        exclude: takes a window, s from the start of the recording, of a capture that is to be left out.
        print_line: takes a line on a capture, and on poses that are all within tolerance.
    """

    def __init__(
        self,
        rig: Rig,
        source: str,
        pools: SessionPools,
        solve: Solve | None = None,
        *,
        exclude: Callable[[tuple[float, float]], object],
        print_line: Callable[[str], object],
    ) -> None:
        # With the trigger of the session, and a background window.
        super().__init__(prepare_live_rig(rig), source, pools, print_line)
        self._solve, self._exclude = solve, exclude
        self.analysis = MessageAnalysis(self.rig, source)
        self.taker = CaptureTaker(self.rig, self.analysis, self._write_trigger, print_line)
        self._solved_captures: tuple[object, ...] = ()
        self._advancing = False

    def rebuild(self, recording: Recording, engine: Engine = THIS_PROCESS) -> None:
        """Continues after what was recorded before, with its captures; called before the first message.

        Args:
            recording: of the session until now; it is read as :func:`calgraph.calibrate_rig` does, which
                takes as long as a calibration.
            engine: searches the board.

        Raises:
            RecordingError: it cannot be read.
        """
        rig, triggers = self.rig, list[float]()
        wanted = {*rig.topics.values(), *self.analysis.detectors.intrinsics_topics, TRIGGER_TOPIC}
        for item in list_messages(recording, wanted.intersection(topic.name for topic in recording.topics), -1):
            if isinstance(item, LiveMessage):
                self.analysis.feed(item, is_past=True)
                if item.channel.topic == TRIGGER_TOPIC:
                    triggers.append(item.read(self._source, rig.settings.limits).stamp)
        offsets = {rig.topics[name]: offset for name, offset in self.analysis.timeline.clock_offsets.items()}
        method = DetectionMethod(self.analysis.detectors.cameras, self.analysis.detectors.seeds)
        captures = find_captures(
            rig, correct_stamps(recording, offsets), self.analysis.timeline.snapshot(triggers), method, engine
        )
        self.taker.restore(captures, self.taker.finder.now())
        self.advance()

    def feed(self, message: LiveMessage) -> None:
        """Takes a message that has been recorded; the work is left to other processes, which may skip it."""
        self.analysis.feed(message)
        self.advance()

    def act(self, action: Action) -> None:
        """Does what the operator wants."""
        match action:
            case "trigger":
                self.taker.request()
            case "automatic" | "manual":
                self.taker.automatic = action == "automatic"
            case "discard":
                self._discard()
        self.advance()

    def describe(self) -> SessionState:
        """The session now; see :meth:`Session.describe`."""
        solution, taker = self.solution, self.taker
        phase, headline = self._describe_phase()
        return SessionState(
            "rig",
            phase,
            ALL_DONE if self.done and phase == "ready" else headline,
            automatic=taker.automatic,
            captures=len(taker.captures),
            event=taker.event,
            advice=solution.advice if solution else None,
            scene=solution.scene if solution else None,
        )

    def list_sensor_states(self) -> Iterator[SensorState]:
        """Sensors by their messages and captures; see :meth:`Session.list_sensor_states`."""
        analysis, captures = self.analysis, self.taker.captures
        problems = analysis.timeline.find_problems()
        for name, spec in self.rig.sensors.items():
            times, activity = analysis.timeline.sensors[name], analysis.sensors[name]
            yield SensorState(
                name=name,
                kind=spec.kind,
                rate=times.rate,
                problem=problems.get(name, "") or times.describe_malformed(),
                sees_board=activity.view.sees_board if activity.view else None,
                reason=activity.explain_view(),
                moving=analysis.rests.is_moving(name),
                captures=sum(name in capture.sensors for capture in captures),
                coverage=count_coverage(name, self.rig, analysis.detectors.cameras.get(name), captures),
                picture=activity.pictures,
            )

    def _describe_phase(self) -> tuple[Phase, str]:
        analysis, taker = self.analysis, self.taker
        unheard = [name for name in analysis.sensors if analysis.timeline.age(name) is None]
        waiting = taker.waiting
        if unheard:
            return "connecting", f"Waiting for messages of {name_sensors(unheard)}"
        if analysis.background_left:
            return "background", f"Stay out of view: {np.ceil(analysis.background_left):.0f} s to learn the room"
        if waiting.problem:
            return "ready", f"No captures are possible: {waiting.problem}"
        if taker.searching:
            return "measuring", "Searching for the board"
        if waiting.phase == "measuring" and (taker.requested or taker.automatic):
            names = name_sensors(waiting.sensors)
            return "measuring", f"Hold still: {names} measuring" if names else "Hold still"
        if taker.requested:
            moving = f" (motion in {name_sensors(waiting.sensors)})" if waiting.sensors else ""
            return "waiting", f"Hold the board still{moving}, or press again to capture while it moves"
        if taker.automatic:
            return "ready", "Hold the board still in a new pose"
        return "ready", "Hold the board still and press the button"

    def picture(self, sensor: str) -> bytes | None:
        """The view of a sensor with the board drawn in, a JPEG image; None before the first."""
        activity = self.analysis.sensors.get(sensor)
        view = activity.view if activity else None
        return view.picture or None if view else None

    def captures(self) -> CaptureSet:
        """The captures so far."""
        return collect_live_captures(
            self.rig, self.analysis.timeline, self.taker.captures, self.analysis.detectors.cameras
        )

    @property
    def lag(self) -> float:  # type: ignore[override]
        """Time by which the detection is behind the messages, s; 0 where nothing is detected any more."""
        return max(self.analysis.lag, self.taker.lag) if self._queue.running else 0.0

    def advance(self) -> None:
        """Takes captures, and keeps the processes busy with what is most urgent."""
        if self._advancing:
            return
        self._advancing = True
        try:
            self.taker.advance()
            while self._queue.idle and (self.taker.start_job(self._queue) or self.analysis.start_job(self._queue)):
                self.taker.advance()
            self._start_solving()
        finally:
            self._advancing = False

    def _start_solving(self) -> None:
        """Solves for the newest captures, if they have not been, and no solution is being computed."""
        captures = tuple(self.taker.captures)
        if self._solve is None or not captures or not self._solver.idle or captures == self._solved_captures:
            return
        self._solved_captures = captures
        self._solver.run(self.take, self._solve, self._state_intrinsics(), self.captures(), self.solution)

    def _state_intrinsics(self) -> Rig:
        """The rig with the intrinsics that have arrived."""
        sensors = {
            name: self.rig.cameras()[name].model_copy(
                update={"camera_info": None, "intrinsics": Intrinsics.from_camera(camera)}
            )
            for name, camera in self.analysis.detectors.cameras.items()
        }
        return self.rig.model_copy(update={"sensors": {**self.rig.sensors, **sensors}})

    def take(self, solution: LiveSolution | Rejected | None) -> None:
        """See :meth:`Session.take`; captures may have been left out meanwhile."""
        if isinstance(solution, Rejected) or self.taker.captures:
            super().take(solution)

    def _write_trigger(self, stamp: float) -> None:
        self.triggers.append(make_trigger(stamp, self.analysis.timeline.latest_arrival))

    def _discard(self) -> None:
        capture = self.taker.discard()
        begin = self.analysis.timeline.start
        if capture is None or begin is None:
            return
        if not self.taker.captures:
            self.solution = None
        # Within the capture, so that rounding does not touch those before and after.
        start, end = capture.hold.start - begin, capture.hold.end - begin
        margin = (end - start) / 10
        self._exclude((start + margin, end - margin))


def find_captures(
    rig: Rig, recording: Recording, timeline: RecordingTimeline, method: DetectionMethod, engine: Engine
) -> list[LiveCapture]:
    """The captures in the recording of an interrupted session.

    Args:
        rig: of the session; see :func:`calgraph.live.live_rig.prepare_live_rig`. Sensors may be missing in the
            recording.
        recording: until the interruption.
        timeline: of the recording.
        method: of the detection; cameras without intrinsics are left out.
        engine: searches the board.

    Raises:
        RecordingError: it cannot be read.
    """
    try:
        holds = limit_messages(find_holds(timeline, rig.capture, rig.settings.captures), rig)
    except CalibrationError:  # none yet
        return []
    present = {topic.name for topic in recording.topics}
    detecting = {
        name: spec
        for name, spec in rig.sensors.items()
        if spec.topic in present and (KINDS[spec.kind].measures_ranges or name in method.cameras)
    }
    part = rig.model_copy(update={"sensors": detecting})
    found = detect_by_sensors(part, recording, timeline, holds, method, engine=engine)
    by_hold: dict[int, dict[str, DetectionResult]] = {hold.index: {} for hold in holds}
    for one in found:
        by_hold[one.capture][one.sensor] = one.detections
    return [
        LiveCapture(hold, {name: by_hold[hold.index].get(name, Rejected(NO_INTRINSICS)) for name in rig.sensors})
        for hold in holds
    ]
