"""Connections of the page's server: a bounded number, and none that sends nothing."""

import asyncio

from uvicorn.protocols.http.h11_impl import H11Protocol

from calgraph.config.settings import PageSettings
from calgraph.live.refusals import Refusals


def make_bounded_protocol(settings: PageSettings, refusals: Refusals) -> type[asyncio.Protocol]:
    """The protocol of one connection; uvicorn alone bounds neither how many there are nor how long one is idle."""

    class BoundedProtocol(H11Protocol):
        _deadline: asyncio.TimerHandle | None = None

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            if len(self.connections) > settings.max_connections:
                refusals.add("connections beyond the limit")
                transport.abort()
            else:
                self._deadline = self.loop.call_later(settings.timeout, self._end_without_request)

        def connection_lost(self, exc: Exception | None) -> None:
            if self._deadline:
                self._deadline.cancel()
            super().connection_lost(exc)

        def send_400_response(self, msg: str) -> None:
            refusals.add("malformed requests")
            super().send_400_response(msg)

        def _end_without_request(self) -> None:
            # A websocket has another protocol by now.
            if self.cycle is None and self.transport.get_protocol() is self:
                refusals.add("requests that took too long")
                self.transport.abort()

    return BoundedProtocol
