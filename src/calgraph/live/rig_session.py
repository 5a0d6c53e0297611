"""A live session of a rig: from its messages to captures, poses, and the state that the operator is shown."""

import asyncio
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field

from calgraph.config import Intrinsics, Rig
from calgraph.live.capture_taker import CaptureTaker
from calgraph.live.job_queue import JobQueue, Post
from calgraph.live.live_captures import collect_live_captures
from calgraph.live.live_rig import make_trigger, prepare_live_rig
from calgraph.live.message_analysis import MessageAnalysis
from calgraph.live.rebuild import rebuild_captures
from calgraph.live.rig_scene import make_scene
from calgraph.live.rig_solution import LiveSolution
from calgraph.live.rig_state import describe_rig_session
from calgraph.live.scene_view import encode_scene
from calgraph.live.source import LiveMessage
from calgraph.live.state import Command, SessionState
from calgraph.parallel.engine import THIS_PROCESS, Engine
from calgraph.parallel.processes import available_cores
from calgraph.recording import Recording
from calgraph.rig.captures.detect import CaptureSet

Solve = Callable[[Rig, CaptureSet, LiveSolution | None], LiveSolution]
"""Computes the poses from the captures until now and the last solution; defined at module level."""


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


@dataclass(frozen=True)
class SessionOutputs:
    """Where a session writes."""

    record: Callable[[LiveMessage], object]
    """Records a trigger."""
    exclude: Callable[[tuple[float, float]], object] = field(default=lambda _window: None)
    """Takes a window, s from the start of the recording, of a capture that is to be left out."""


def count_analysis_processes(rig: Rig) -> int:
    """The number of processes that detect on this machine: one core is left to the recorder and the page."""
    return max(1, min(available_cores() - 1, rig.settings.live.analysis_processes))


class RigSession:
    """Detects the board in live messages, takes captures, and calibrates after each of them.

    All calls are made in one thread, and none blocks. Captures are those that ``calgraph calibrate`` finds in the
    recording of the same messages and triggers with the rig :attr:`rig`.

    Args:
        rig: as its user wrote it.
        source: name of the source.
        pools: where it computes.
        outputs: where it writes.
        solve: computes poses; none are computed if left out.
    """

    def __init__(
        self, rig: Rig, source: str, pools: SessionPools, outputs: SessionOutputs, solve: Solve | None = None
    ) -> None:
        self.rig = prepare_live_rig(rig)
        """The rig of the recording: with the trigger of the session, and a background window."""
        self._source, self._outputs, self._solve = source, outputs, solve
        self.analysis = MessageAnalysis(self.rig, source, self._note_change)
        self.taker = CaptureTaker(self.rig, self.analysis, self._write_trigger, self._note_change)
        self._queue = JobQueue(pools.analysis, pools.analysis_processes, self._post_to(pools.post))
        self._solver = JobQueue(pools.solving, 1, self._post_to(pools.post))
        self.solution: LiveSolution | None = None
        """The last one; None before the first."""
        self._scene: bytes | None = None
        self.solutions = 0
        """Number of solutions so far."""
        self._solved_captures: tuple[object, ...] = ()
        self._problem = ""
        self._state: SessionState | None = None
        self._shown_at = float("-inf")
        self._change = asyncio.Event()
        self._pumping = False

    def rebuild(self, recording: Recording, engine: Engine = THIS_PROCESS) -> None:
        """Continues after what was recorded before, with its captures; called before the first message.

        Args:
            recording: of the session until now; it is read as :func:`calgraph.calibrate_rig` does, which
                takes as long as a calibration.
            engine: searches the board.

        Raises:
            RecordingError: it cannot be read.
        """
        rebuilt = rebuild_captures(self.rig, recording, self.analysis.detectors.seeds, engine)
        window = self.rig.capture.background
        present = {topic.name for topic in recording.topics}
        times = [recording.start + time for time in window] if window else [0.0, 0.0]
        background = recording.records([t for t in self.rig.topics.values() if t in present], *times)
        self.analysis.restore(rebuilt.timeline, recording.end, rebuilt.cameras, background)
        self.taker.restore(rebuilt.captures, self.taker.finder.now())
        self._note_change()
        self._pump()

    def feed(self, message: LiveMessage) -> None:
        """Takes a message that has been recorded; the work is left to other processes, which may skip it."""
        self.analysis.feed(message)
        # Rates and ages are shown without any other change.
        arrival = self.analysis.timeline.latest_arrival
        if arrival - self._shown_at >= 1 / self.rig.settings.live.view.rate:
            self._shown_at = arrival
            self._note_change()
        self._pump()

    def command(self, command: Command) -> None:
        """Does what the operator wants; ``finish`` concerns who owns the session."""
        match command.action:
            case "trigger":
                self.taker.request()
            case "automatic" | "manual":
                self.taker.automatic = command.action == "automatic"
            case "discard":
                self._discard()
        self._note_change()
        self._pump()

    def state(self) -> SessionState:
        """The session now, without what concerns source and recorder; another object after each change."""
        if self._state is None:
            killed = self._queue.problem or self._solver.problem
            problem = f"Only recording goes on: {killed}" if killed else self._problem
            self._state = describe_rig_session(
                self.rig, self._source, self.analysis, self.taker, self.solution, self.solutions, problem
            )
        return self._state

    async def wait_for_change(self, state: SessionState) -> None:
        """Returns as soon as :meth:`state` is another object than ``state``."""
        while self._state is state:
            self._change.clear()
            await self._change.wait()

    def picture(self, sensor: str) -> bytes | None:
        """The view of a sensor with the board drawn in, a JPEG image; None before the first."""
        activity = self.analysis.sensors.get(sensor)
        view = activity.view if activity else None
        return view.picture or None if view else None

    def scene(self) -> bytes | None:
        """The 3-D view of the last solution; None before the first."""
        return self._scene

    def captures(self) -> CaptureSet:
        """The captures so far."""
        return collect_live_captures(
            self.rig, self.analysis.timeline, self.taker.captures, self.analysis.detectors.cameras
        )

    @property
    def busy(self) -> bool:
        """Whether other processes work for the session."""
        return self._queue.running + self._solver.running > 0

    @property
    def lag(self) -> float:
        """Time by which the detection is behind the messages, s; 0 where nothing is detected any more."""
        return max(self.analysis.lag, self.taker.lag) if self._queue.running else 0.0

    def close(self) -> None:
        """Ends the session: results of calls under way are ignored."""
        self._queue.closed = self._solver.closed = True

    def _post_to(self, post: Post) -> Post:
        """Has results handled in the thread of the session, and then further calls started."""

        def handle(function: Callable[[], None]) -> None:
            function()
            self._pump()

        return lambda function: post(lambda: handle(function))

    def _pump(self) -> None:
        """Takes captures, and keeps the processes busy with what is most urgent."""
        if self._pumping:
            return
        self._pumping = True
        try:
            self.taker.advance()
            while self._queue.idle and (self.taker.start_job(self._queue) or self.analysis.start_job(self._queue)):
                self.taker.advance()
            self._start_solving()
        finally:
            self._pumping = False

    def _start_solving(self) -> None:
        """Solves for the newest captures, if they have not been, and no solution is being computed."""
        captures = tuple(self.taker.captures)
        if self._solve is None or not captures or not self._solver.idle or captures == self._solved_captures:
            return
        self._solved_captures = captures
        self._solver.run(
            self._solve, self._state_intrinsics(), self.captures(), self.solution,
            done=self._set_solution, failed=self._fail_solving,
        )  # fmt: skip

    def _state_intrinsics(self) -> Rig:
        """The rig with the intrinsics that have arrived."""
        sensors = {
            name: self.rig.cameras()[name].model_copy(
                update={"camera_info": None, "intrinsics": Intrinsics.from_camera(camera)}
            )
            for name, camera in self.analysis.detectors.cameras.items()
        }
        return self.rig.model_copy(update={"sensors": {**self.rig.sensors, **sensors}})

    def _set_solution(self, solution: LiveSolution) -> None:
        captures = self.taker.captures
        if not captures:  # they were left out meanwhile
            return
        self.solution = solution
        self._scene = encode_scene(make_scene(self.rig, solution, captures, self.analysis.detectors.cameras))
        self._problem = ""
        self.solutions += 1
        self._note_change()

    def _fail_solving(self, error: BaseException) -> None:
        self._problem = f"No poses from the captures until now: {error}"
        self._note_change()

    def _write_trigger(self, stamp: float) -> None:
        self._outputs.record(make_trigger(stamp, self.analysis.timeline.latest_arrival))

    def _discard(self) -> None:
        capture = self.taker.discard()
        begin = self.analysis.timeline.start
        if capture is None or begin is None:
            return
        if not self.taker.captures:
            self.solution = self._scene = None
        # Within the capture, so that rounding does not touch those before and after.
        start, end = capture.hold.start - begin, capture.hold.end - begin
        margin = (end - start) / 10
        self._outputs.exclude((start + margin, end - margin))

    def _note_change(self) -> None:
        self._state = None
        self._change.set()
