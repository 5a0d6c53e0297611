"""What the user gives as a source: an address, or the path of a recording; and the clock of its arrivals."""

import asyncio
import math
from collections.abc import AsyncIterator, Collection, Mapping
from contextlib import aclosing
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from calgraph.config.settings import ConnectionSettings, Settings
from calgraph.errors import InputError
from calgraph.io.yaml_reading import suggest_name
from calgraph.live.dds import DdsSource
from calgraph.live.foxglove import FoxgloveSource
from calgraph.live.replay import ReplaySource
from calgraph.live.source import LiveMessage, Notice, Source


def open_source(
    text: str, settings: Settings, *, speed: float = 1.0, start_after: int = -1, but: Collection[str] | None = None
) -> Source:
    """The source that a text names; it connects when it is streamed.

    Args:
        text: ``ws://HOST:PORT`` or ``wss://HOST:PORT`` of a Foxglove bridge, ``ros2:`` or
            ``ros2://DOMAIN/NAMESPACE``, or the path of a recording.
        settings: of connections, and limits of what is read.
        speed: of a recording: 1 is real time, 5 five times as fast, 0 as fast as messages are consumed.
        start_after: of a recording, to resume a session; see :class:`ReplaySource`. Likewise ``but``.
        but: topics.

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
    return ReplaySource(path, speed=speed, start_after=start_after, but=but, limits=settings.limits)


_NS_PER_SECOND = 1e9


# Time from the first message until the clocks of stamps and arrivals are compared, s: most sensors have sent
# messages, and one with a wrong clock does not decide alone.
_ALIGNMENT_TIME = 1.0


class AlignedSource:
    """A source whose arrivals are by the clock of the stamps.

    Windows in rig.yaml count from the first arrival, and are compared with stamps. Robots without a time server,
    and recordings that are played to a bridge, have stamps that differ from arrivals by seconds to years. The
    difference is estimated from the first messages, and is constant after that.

    Args:
        source: of the messages.
        settings: of connections.
    """

    max_lead = math.inf

    def __init__(self, source: Source, settings: ConnectionSettings) -> None:
        self.name = source.name
        self._source, self._settings = source, settings

    async def stream(self, topics: Collection[str]) -> AsyncIterator[LiveMessage | Notice]:
        """Messages and notices of the source; see :meth:`Source.stream`. The first messages come delayed."""
        now = asyncio.get_running_loop().time
        offsets, waiting = dict[str, int](), list[LiveMessage]()
        shift: int | None = None
        end = math.inf
        # A generator, whose connection is closed with it.
        async with aclosing(cast(Any, self._source.stream(topics))) as items:
            async for item in items:
                if isinstance(item, Notice):
                    yield item
                    continue
                if item is not None:
                    waiting.append(item)
                    if shift is None and (stamp := item.read_stamp()) is not None:
                        offsets.setdefault(item.channel.topic, item.arrival - stamp)
                if shift is None and waiting:
                    end = min(end, now() + _ALIGNMENT_TIME)
                    if now() < end:
                        continue
                    end = math.inf
                    # Without stamps they cannot be compared.
                    shift = self._choose_shift(offsets) if offsets else None
                    if shift:
                        yield Notice("connected", self._describe(shift))
                for one in waiting:
                    yield replace(one, arrival=one.arrival - (shift or 0))
                waiting.clear()
            for one in waiting:
                yield replace(one, arrival=one.arrival - self._choose_shift(offsets))

    def _choose_shift(self, offsets: Mapping[str, int]) -> int:
        """The median difference of the topics, ns; 0 where it is a latency."""
        ordered = sorted(offsets.values())
        middle = ordered[(len(ordered) - 1) // 2 : len(ordered) // 2 + 1]
        # Of two topics that contradict each other, one may have the clock of the arrivals.
        offset = min(middle, key=abs, default=0)
        return offset if abs(offset) > self._settings.max_clock_offset * _NS_PER_SECOND else 0

    def _describe(self, shift: int) -> str:
        side = "behind" if shift > 0 else "ahead of"
        return (
            f"{self.name}: stamps are {abs(shift) / _NS_PER_SECOND:.1f} s {side} the clock of arrivals, which is "
            "set to theirs"
        )
