"""What the page needs of a session: its state, its pictures, and where commands of the operator go."""

from pathlib import Path
from typing import Protocol

from calgraph.live.state import Command, SessionState


class SessionView(Protocol):
    """A session as the page uses it, all calls in one asyncio loop. None of them blocks."""

    def state(self) -> SessionState:
        """The session now. Whenever something has changed it is another object."""

    async def wait_for_change(self, state: SessionState) -> None:
        """Returns as soon as :meth:`state` is another object than ``state``."""

    def picture(self, sensor: str) -> bytes | None:
        """The view of a sensor with the board drawn in, a JPEG image; None before the first."""

    def scene(self) -> bytes | None:
        """The 3-D view as :func:`calgraph.live.rig_session.encode_scene` writes it; None before the first."""

    def report(self) -> Path | None:
        """The report of the calibration; None as long as there is none."""

    def command(self, command: Command) -> None:
        """Takes a command of the operator."""
