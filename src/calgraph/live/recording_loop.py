"""From the source into the recorder, and from there to the session, until the source or the operator ends it."""

import asyncio
from collections import deque
from contextlib import AbstractAsyncContextManager, aclosing, suppress
from typing import Any, Protocol, cast

from calgraph.config import Rig
from calgraph.errors import RecordingError
from calgraph.live.live_rig import list_intrinsics_topics
from calgraph.live.operator_view import CapturingSession, OperatorView
from calgraph.live.source import LiveMessage, Notice, Source

# Time between two looks at whether other processes still work, s: much less than their calls take.
_IDLE_CHECK = 0.002


class MessageSink(Protocol):
    """Where messages are recorded."""

    async def write(self, message: LiveMessage) -> None:
        """Records a message; waits while too many wait for the disk.

        Raises:
            RecordingError: the recording has ended, and why.
        """


class FedSession(CapturingSession, Protocol):
    """A session that takes messages."""

    @property
    def busy(self) -> bool:
        """Whether other processes work for it."""

    @property
    def lag(self) -> float:
        """Time by which the processes that detect are behind the messages, s; 0 as soon as they wait for more."""

    def feed(self, message: LiveMessage) -> None:
        """Takes a message that has been recorded."""

    def close(self) -> None:
        """Ends the session: results of calls under way are ignored."""


class TriggerQueue:
    """Triggers of a session that are to be recorded, each before the messages that follow it."""

    def __init__(self) -> None:
        self._waiting: deque[LiveMessage] = deque()

    def put(self, trigger: LiveMessage) -> None:
        """Adds one."""
        self._waiting.append(trigger)

    async def record(self, recorder: MessageSink) -> None:
        """Records those that wait.

        Raises:
            RecordingError: the recording has ended, and why.
        """
        while self._waiting:
            await recorder.write(self._waiting.popleft())


async def record_session(
    source: Source,
    rig: Rig,
    recorder: MessageSink,
    session: FedSession,
    triggers: TriggerQueue,
    view: OperatorView,
    *,
    max_lead: float,
) -> None:
    """Records and feeds messages until the source or the recording ends, or the operator wants to finish.

    Args:
        source: of the messages.
        rig: whose topics are recorded.
        recorder: gets every message before the session does.
        session: takes the captures.
        triggers: of the session.
        view: shows notices of the source, and has the operator's wish to finish.
        max_lead: time by which messages may be ahead of the detection before they wait until it has caught up, s;
            with 0 each waits until all before it are analysed. Infinite for robots, which do not wait.

    Raises:
        InputError: the source cannot be used.
        RecordingError: what the source reads is damaged.
    """
    sensors = frozenset(rig.topics.values())
    # Cameras have one of several, or none where rig.yaml is to state the intrinsics.
    intrinsics = frozenset(topic for topics in list_intrinsics_topics(rig).values() for topic in topics)
    # Networks are calibrated again from the whole recording.
    max_wait = 0.0 if rig.is_network else rig.settings.live.capture.timeout

    async def receive() -> None:
        # A generator, whose connection is closed with it.
        stream = cast(AbstractAsyncContextManager[Any], aclosing(cast(Any, source.stream(sensors | intrinsics))))
        async with stream as items:
            async for item in items:
                if isinstance(item, Notice):
                    if item.kind != "missing" or item.topic in sensors:
                        view.note(item)
                elif not await record(item):
                    return
        with suppress(TimeoutError):
            await asyncio.wait_for(wait_until_idle(), max_wait)

    async def record(message: LiveMessage) -> bool:
        try:
            await triggers.record(recorder)
            await recorder.write(message)
        except RecordingError as error:
            view.note(Notice("ended", str(error)))
            return False
        session.feed(message)
        if not max_lead:
            await wait_until_idle()
        elif session.lag > max_lead:
            while session.lag:
                await asyncio.sleep(_IDLE_CHECK)
        return True

    async def wait_until_idle() -> None:
        while session.busy:
            await asyncio.sleep(_IDLE_CHECK)

    tasks = [asyncio.create_task(receive()), asyncio.create_task(view.finish_wanted.wait())]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    with suppress(RecordingError):  # the view shows it already
        await triggers.record(recorder)
