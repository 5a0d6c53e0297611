"""A live source that is ROS 2 itself: DDS through cyclonedds, without an installation of ROS."""

import asyncio
import os
import re
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Collection, Iterator

from calgraph.config.settings import ConnectionSettings
from calgraph.errors import InputError
from calgraph.live.dds_readers import DdsReaders, Event
from calgraph.live.notice_limiter import NoticeLimiter
from calgraph.live.source import Channel, LiveMessage, Notice
from calgraph.live.topic_watch import TopicWatch

_ADDRESS = re.compile(r"ros2:(?://(\d{0,3})(?:/([\w/]*))?)?")
# Domains whose ports exist (DDSI-RTPS, section 9.6.1.1).
_MAX_DOMAIN = 232
# The time for which a thread waits for samples before it looks whether it is to end, s.
_WAIT = 0.1


class _Events:
    """What a thread has received and the loop has not yet taken; bounded."""

    def __init__(self, loop: asyncio.AbstractEventLoop, max_bytes: int) -> None:
        self._loop, self._max_bytes = loop, max_bytes
        self._events: deque[Event] = deque()
        self._bytes = 0
        self._lost: dict[str, int] = {}
        self._lock = threading.Lock()
        self._arrived = asyncio.Event()

    def put(self, event: Event) -> None:
        """Called by the thread; messages that do not fit are counted."""
        with self._lock:
            if isinstance(event, LiveMessage):
                if self._bytes + len(event.data) > self._max_bytes:
                    topic = event.channel.topic
                    self._lost[topic] = self._lost.get(topic, 0) + 1
                    return
                self._bytes += len(event.data)
            self._events.append(event)
        self._loop.call_soon_threadsafe(self._arrived.set)

    async def take(self) -> AsyncIterator[Event]:
        """What has been received, after waiting for it for some time."""
        try:
            async with asyncio.timeout(_WAIT):
                await self._arrived.wait()
        except TimeoutError:
            return
        self._arrived.clear()
        while self._events:
            with self._lock:
                event = self._events.popleft()
                self._bytes -= len(event.data) if isinstance(event, LiveMessage) else 0
            yield event

    def take_lost(self) -> Iterator[Notice]:
        """The messages that did not fit."""
        with self._lock:
            lost, self._lost = self._lost, {}
        for topic, count in lost.items():
            yield Notice("lost", f"{topic}: messages arrive faster than they are recorded", topic, count)


class DdsSource:
    """The topics of a ROS 2 domain.

    Args:
        address: ``ros2:``, or ``ros2://DOMAIN/NAMESPACE``. Without a number the domain is that of ROS_DOMAIN_ID,
            or 0. Topics keep their names of rig.yaml, without the namespace.
        settings: of connections.

    Raises:
        InputError: the address is malformed, or cyclonedds is not installed.
    """

    def __init__(self, address: str, settings: ConnectionSettings) -> None:
        match = _ADDRESS.fullmatch(address)
        number = (match and match[1]) or os.environ.get("ROS_DOMAIN_ID") or "0"
        if not match or not number.isdecimal() or int(number) > _MAX_DOMAIN:
            raise InputError(
                f"{address}: is no address of ROS 2 (domain {number}): give ros2: or ros2://DOMAIN/NAMESPACE with "
                f"a domain from 0 to {_MAX_DOMAIN}"
            )
        try:
            import cyclonedds.domain  # noqa: F401  # only whether it is there
        except ImportError as error:
            raise InputError(
                f"{address}: ROS 2 needs cyclonedds, which is not installed: pip install 'calgraph[ros2]'"
            ) from error
        self._address, self._settings = address, settings
        self._domain, self._namespace = int(number), match[2] or ""

    @property
    def name(self) -> str:
        """The address."""
        return self._address

    async def stream(self, topics: Collection[str]) -> AsyncIterator[LiveMessage | Notice]:
        """Messages of the topics wanted, and notices; see :meth:`Source.stream`. Never ends by itself.

        Raises:
            InputError: the domain cannot be joined.
        """
        settings, now = self._settings, asyncio.get_running_loop().time
        events = _Events(asyncio.get_running_loop(), settings.max_queue_bytes)
        readers = await asyncio.to_thread(DdsReaders, topics, self._domain, self._namespace)
        stop = threading.Event()
        thread = threading.Thread(target=_read, args=(readers, events, stop), daemon=True)
        watch, notices = TopicWatch(settings), NoticeLimiter(settings.notice_interval)
        subscribed: set[str] = set()
        discovery_end = now() + settings.discovery_time
        thread.start()
        try:
            yield Notice("connected", f"joined domain {self._domain} of ROS 2")
            while True:
                async for event in events.take():
                    if isinstance(event, Channel):
                        watch.start(event, now())
                        subscribed.add(event.topic)
                    elif isinstance(event, Notice):
                        if event.kind == "ended":
                            yield event
                            return
                        notices.add(event.kind, event.text, event.topic, event.count)
                        subscribed |= {event.topic} if event.topic else set()
                    else:
                        if lost := watch.observe(event, now()):
                            notices.add(lost.kind, lost.text, lost.topic, lost.count)
                        yield event
                if now() >= discovery_end:
                    discovery_end = float("inf")
                    for topic in topics:
                        if topic not in subscribed:
                            text = f"{topic}: nothing publishes it in domain {self._domain} of ROS 2"
                            notices.add("missing", text, topic)
                for one in (*events.take_lost(), *watch.find_silent(now())):
                    notices.add(one.kind, one.text, one.topic, one.count)
                for one in notices.take(now()):
                    yield one
        finally:
            stop.set()
            await asyncio.to_thread(thread.join)


def _read(readers: DdsReaders, events: _Events, stop: threading.Event) -> None:
    """Reads until it is to stop; the function of a thread."""
    try:
        while not stop.is_set():
            for event in readers.read(_WAIT, time.time_ns):
                events.put(event)
    except Exception as error:  # the stream ends with its text
        events.put(Notice("ended", f"reading from DDS failed: {error}"))
    finally:
        readers.close()
