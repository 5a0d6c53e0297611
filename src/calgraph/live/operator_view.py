"""A session as the operator's page shows it: with what concerns the source, the recorder and the result."""

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from calgraph.live.source import Notice
from calgraph.live.state import Command, Phase, RecorderState, SessionState

# More do not fit on a phone.
_SHOWN_NOTICES = 5


class CapturingSession(Protocol):
    """A session of a rig or of a network. All calls are made in one asyncio loop, and none blocks."""

    def command(self, command: Command) -> None:
        """Does what the operator wants."""

    def state(self) -> SessionState:
        """The session now; another object after each change."""

    async def wait_for_change(self, state: SessionState) -> None:
        """Returns as soon as :meth:`state` is another object than ``state``."""

    def picture(self, sensor: str) -> bytes | None:
        """The view of a sensor, a JPEG image."""

    def scene(self) -> bytes | None:
        """The 3-D view."""


class RecordingStatus(Protocol):
    """What has been recorded."""

    @property
    def state(self) -> RecorderState:
        """It now."""


class OperatorView:
    """What the page shows of a session, and where its commands go: a :class:`SessionView`.

    Args:
        session: takes the captures.
        print_line: takes a line on what has happened to the connection.
    """

    def __init__(self, session: CapturingSession, print_line: Callable[[str], object]) -> None:
        self._session, self._print_line = session, print_line
        self._recorder: RecordingStatus | None = None
        self._notices: deque[str] = deque(maxlen=_SHOWN_NOTICES)
        self._connected = False
        self._lost = self._gaps = 0
        self._end: tuple[Phase, str, bool] | None = None
        self._report: Path | None = None
        self._state: SessionState | None = None
        self._shown: SessionState | None = None
        """The session's state that ``_state`` was made of."""
        self._change = asyncio.Event()
        self.finish_wanted = asyncio.Event()
        """Set when the operator ends the session."""

    def show_recorder(self, recorder: RecordingStatus) -> None:
        """From now on shows what is recorded."""
        self._recorder = recorder
        self._note_change()

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
        self._note_change()

    def show_end(self, phase: Phase, headline: str, report: Path | None = None, *, done: bool = False) -> None:
        """From now on shows a phase of the end of the session, in place of those of the captures.

        Args:
            phase: ``finishing``, ``finished`` or ``failed``.
            headline: one sentence.
            report: of the calibration, if there is one.
            done: whether all poses are good.
        """
        self._end, self._report = (phase, headline, done), report
        self._note_change()

    def state(self) -> SessionState:
        """The session now. Whenever something has changed it is another object."""
        shown = self._session.state()
        if self._state is None or shown is not self._shown:
            self._shown = shown
            recorded = self._recorder.state if self._recorder else RecorderState()
            phase, headline, done = self._end or (shown.phase, shown.headline, shown.done)
            self._state = replace(
                shown,
                phase=phase,
                headline=headline,
                done=done,
                connected=self._connected,
                notices=(*self._notices, *shown.notices)[:_SHOWN_NOTICES],
                recorder=replace(recorded, lost=self._lost, gaps=self._gaps),
                report=self._report is not None,
            )
        return self._state

    async def wait_for_change(self, state: SessionState) -> None:
        """Returns as soon as :meth:`state` is another object than ``state``."""
        while self.state() is state:
            self._change.clear()
            assert self._shown is not None
            waiting = {
                asyncio.ensure_future(self._change.wait()),
                asyncio.ensure_future(self._session.wait_for_change(self._shown)),
            }
            try:
                await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for task in waiting:
                    task.cancel()

    def picture(self, sensor: str) -> bytes | None:
        """The view of a sensor with the board drawn in, a JPEG image; None before the first."""
        return self._session.picture(sensor)

    def scene(self) -> bytes | None:
        """The 3-D view; None before the first."""
        return self._session.scene()

    def report(self) -> Path | None:
        """The report of the calibration; None as long as there is none."""
        return self._report

    def command(self, command: Command) -> None:
        """Takes a command of the operator; none has an effect once the session ends."""
        if self._end:
            return
        if command.action == "finish":
            self.finish_wanted.set()
        else:
            self._session.command(command)

    def _note_change(self) -> None:
        self._state = None
        self._change.set()
