"""A live source that is a server of the Foxglove WebSocket protocol, as robots run for looking at their data."""

import asyncio
import os
import time
from collections.abc import AsyncIterator, Collection
from contextlib import suppress
from typing import TYPE_CHECKING

from calgraph.config.settings import ConnectionSettings
from calgraph.errors import InputError
from calgraph.live.foxglove_protocol import SUBPROTOCOLS, FoxgloveClient
from calgraph.live.notice_limiter import clean_text
from calgraph.live.source import LiveMessage, Notice

if TYPE_CHECKING:
    from websockets.asyncio.client import ClientConnection, connect

# While no frame comes, time passes for silence and notices in steps of this, s.
_TICK = 0.25
# Frames that are received and not yet read; the connection is not read from while they wait.
_MAX_QUEUED_FRAMES = 16
# Why a client ends a connection (RFC 6455, section 7.4.1).
_REFUSALS = {
    1002: "a frame is malformed and ended the connection",
    1007: "a text frame is not UTF-8 and ended the connection",
    1009: "a frame is larger than the limit ({limit}) and ended the connection",
}


# Delay of the first attempt to connect again, s; it doubles with each further one.
_FIRST_DELAY = 0.5
# Maximum delay, s: an operator who has put a cable back waits no longer, and an attempt costs nothing.
_MAX_DELAY = 2.0
# Time between two questions whether the server is still there, s: without them, a robot that lost its power looks
# like one that has nothing to send.
_PING_INTERVAL = 2.0
# Time for the answer, s; behind the frames that a slow wireless link still carries it may take seconds.
_PING_TIMEOUT = 10.0


class FoxgloveSource:
    """A server of the Foxglove WebSocket protocol.

    Args:
        address: ``ws://HOST:PORT`` or ``wss://HOST:PORT``.
        settings: of connections.

    Raises:
        InputError: the address is malformed, or websockets is not installed.
    """

    def __init__(self, address: str, settings: ConnectionSettings) -> None:
        try:
            from websockets.exceptions import InvalidURI
            from websockets.uri import parse_uri
        except ImportError as error:
            raise InputError(
                f"{address}: live sources need websockets, which is not installed: pip install 'calgraph[live]'"
            ) from error
        try:
            host = parse_uri(address).host
        except (InvalidURI, ValueError) as error:
            raise InputError(
                f"{address}: is no address ({error}): give ws://HOST:PORT or wss://HOST:PORT"
            ) from error
        if any(one.isspace() for one in host):
            raise InputError(f"{address}: is no address (spaces): give ws://HOST:PORT or wss://HOST:PORT")
        self._address, self._settings = address, settings

    @property
    def name(self) -> str:
        """The address."""
        return self._address

    async def stream(self, topics: Collection[str]) -> AsyncIterator[LiveMessage | Notice]:
        """Messages of the topics wanted, and notices; see :meth:`Source.stream`. Never ends by itself."""
        from websockets.exceptions import ConnectionClosed, WebSocketException

        settings, now = self._settings, asyncio.get_running_loop().time
        delay, problem = _FIRST_DELAY, ""
        last_receipt: float | None = None
        while True:
            try:
                async with self._connect() as connection:
                    _check_protocol(connection)
                    yield Notice("connected", self._describe_connection(last_receipt))
                    problem, last_receipt = "", time.time()
                    client = FoxgloveClient(topics, settings, now())
                    next_notices = now() + _TICK
                    while True:
                        frame = await _receive_frame(connection)
                        if frame is not None and (message := client.receive(frame, now())):
                            delay, last_receipt = _FIRST_DELAY, time.time()
                            yield message
                        for request in client.take_requests():
                            # A connection that has ended still has frames to read.
                            with suppress(ConnectionClosed):
                                await connection.send(request)
                        if now() >= next_notices:
                            next_notices = now() + _TICK
                            for notice in client.take_notices(now()):
                                yield notice
            except ConnectionClosed as error:
                if error.sent and error.sent.code in _REFUSALS:
                    yield Notice("refused", self._explain_refusal(error.sent.code), count=1)
                reason = "the connection broke"
            except (OSError, WebSocketException) as error:
                # asyncio has other texts for errors of the system; those of names have negative numbers.
                number = getattr(error, "errno", None) or 0
                reason = os.strerror(number).lower() if number > 0 else str(error) or "no answer"
            if reason != problem:
                problem = reason
                yield Notice("disconnected", clean_text(f"{self._address}: {reason}; trying again"))
            await asyncio.sleep(delay)
            delay = min(2 * delay, _MAX_DELAY)

    def _connect(self) -> "connect":
        from websockets.asyncio.client import connect
        from websockets.typing import Subprotocol

        settings = self._settings
        return connect(
            self._address,
            subprotocols=[Subprotocol(name) for name in SUBPROTOCOLS],
            # Sensor data hardly shrink, and local networks are faster than compression.
            compression=None,
            max_size=settings.max_frame_bytes,
            max_queue=_MAX_QUEUED_FRAMES,
            open_timeout=settings.open_timeout,
            ping_interval=_PING_INTERVAL,
            ping_timeout=_PING_TIMEOUT,
            # Robots are reached directly, also where the environment names a proxy for the Internet.
            proxy=None,
        )

    def _describe_connection(self, last_receipt: float | None) -> str:
        if last_receipt is None:
            return f"connected to {self._address}"
        begin, end = (time.strftime("%H:%M:%S", time.localtime(at)) for at in (last_receipt, time.time()))
        gap = time.time() - last_receipt
        return f"connected to {self._address} again; nothing was received for {gap:.1f} s, from {begin} to {end}"

    def _explain_refusal(self, code: int) -> str:
        limit = self._settings.max_frame_bytes / 1e6
        return _REFUSALS[code].format(limit=f"{limit:.3g} MB, settings.live.connection.max_frame_bytes")


async def _receive_frame(connection: "ClientConnection") -> str | bytes | None:
    """The next frame; None if none comes for some time."""
    try:
        async with asyncio.timeout(_TICK):
            return await connection.recv()
    except TimeoutError:
        return None


def _check_protocol(connection: "ClientConnection") -> None:
    """Checks that the server has chosen one of the protocols.

    Raises:
        ConnectionError: it has not.
    """
    if connection.subprotocol is None:
        raise ConnectionError(
            f"it speaks neither {' nor '.join(SUBPROTOCOLS)}: give the port of a Foxglove bridge"
        )
