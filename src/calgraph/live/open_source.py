"""What the user gives as a source: an address, or the path of a recording."""

from pathlib import Path

from calgraph.config.settings import Settings
from calgraph.errors import InputError
from calgraph.io.yaml_reading import suggest_name
from calgraph.live.clock_alignment import AlignedSource
from calgraph.live.dds import DdsSource
from calgraph.live.foxglove import FoxgloveSource
from calgraph.live.replay import ReplaySource
from calgraph.live.source import Source


def open_source(text: str, settings: Settings, *, speed: float = 1.0, start_after: int = -1) -> Source:
    """The source that a text names; it connects when it is streamed.

    Args:
        text: ``ws://HOST:PORT`` or ``wss://HOST:PORT`` of a Foxglove bridge, ``ros2:`` or
            ``ros2://DOMAIN/NAMESPACE``, or the path of a recording.
        settings: of connections, and limits of what is read.
        speed: of a recording: 1 is real time, 5 five times as fast, 0 as fast as messages are consumed.
        start_after: of a recording: only messages that arrived later, ns; to resume a session.

    Raises:
        InputError: it is none of these.
    """
    if text.startswith(("ws:", "wss:")):
        return AlignedSource(FoxgloveSource(text, settings.live.connection), settings.live.connection)
    if text.startswith("ros2:"):
        return AlignedSource(DdsSource(text, settings.live.connection), settings.live.connection)
    path = Path(text)
    if not path.exists():
        raise InputError(f"{text}: is neither an address nor an existing recording{suggest_name(path)}")
    return ReplaySource(path, speed=speed, start_after=start_after, limits=settings.limits)
