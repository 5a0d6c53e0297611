"""The server of the operator's page, in the asyncio loop of the session."""

import asyncio
import errno
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING

from uvicorn.protocols.http.h11_impl import H11Protocol

from calgraph.config.settings import PageSettings
from calgraph.errors import InputError
from calgraph.live.refusals import Refusals
from calgraph.live.session_view import SessionView

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Receive, Scope, Send


DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8790
_MS_PER_SECOND = 1000


@dataclass(frozen=True, eq=False)
class PageServer:
    """A server that runs."""

    host: str
    """That it is bound to."""
    port: int
    token: str | None
    """That the link needs; None if only this machine reaches the server."""
    refusals: Refusals
    pages_opened: Callable[[], int]
    """Number of pages that were ever open."""


def check_page_libraries() -> None:
    """Checks that the page can be served.

    Raises:
        InputError: a library is missing.
    """
    try:
        import starlette  # noqa: F401
        import uvicorn  # noqa: F401
        import websockets  # noqa: F401
    except ImportError:
        raise InputError(
            "live capture needs starlette, uvicorn and websockets, which are not installed:"
            " pip install 'calgraph[live]'"
        ) from None


@asynccontextmanager
async def serve_page(
    view: SessionView, host: str = DEFAULT_HOST, port: int = DEFAULT_PORT, *, settings: PageSettings
) -> AsyncIterator[PageServer]:
    """Serves the page as long as the context lasts.

    Args:
        view: the session.
        host: address to listen on. On any but that of this machine alone, the link needs a random token.
        port: 0 for any that is free.
        settings: of the page.

    Raises:
        InputError: the address cannot be used, or a library is missing.
    """
    check_page_libraries()
    import uvicorn

    from calgraph.live.access import AccessCheck, is_loopback, make_token
    from calgraph.live.page_app import MAX_MESSAGE_BYTES, PageApp

    listening = _listen(host, port, settings)
    address, port, *_ = listening.getsockname()
    refusals = Refusals()
    token = None if is_loopback(address) else make_token()
    app = PageApp(view, settings, refusals)
    check = AccessCheck(app.routes, token, _list_names(host), f"calgraph-{port}", refusals)
    server = uvicorn.Server(
        uvicorn.Config(
            _report_errors(check),
            http=make_bounded_protocol(settings, refusals),
            ws="websockets-sansio",
            ws_max_size=MAX_MESSAGE_BYTES,
            ws_ping_interval=settings.timeout / 2,
            ws_ping_timeout=settings.timeout / 2,
            ws_per_message_deflate=False,
            lifespan="off",
            log_config=None,
            log_level="critical",
            access_log=False,
            proxy_headers=False,
            server_header=False,
            timeout_keep_alive=round(settings.timeout),
            timeout_graceful_shutdown=1,
        )
    )
    # Signals are the program's.
    server.capture_signals = nullcontext  # type: ignore[assignment, method-assign]
    async with app.following():
        serving = asyncio.create_task(server.serve([listening]))
        try:
            yield PageServer(host, port, token, refusals, lambda: app.opened)
        finally:
            server.should_exit = True
            await serving


def _listen(host: str, port: int, settings: PageSettings) -> socket.socket:
    """A socket that listens; other programs on the port are refused, those just ended are not."""
    where = f"`host` {host}, `port` {port}"
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.socket(family, kind, protocol)
    except (OSError, UnicodeError) as error:
        raise _no_address(where, error) from None
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):
            # Otherwise Linux keeps connections to phones that are out of reach for a quarter of an hour.
            milliseconds = round(settings.timeout * _MS_PER_SECOND)
            listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, milliseconds)
        listening.bind(address)
        listening.listen(settings.max_connections)
    except OSError as error:
        listening.close()
        if error.errno == errno.EADDRINUSE:
            reason = "another program listens on that port; give another one, or 0 for any that is free"
        elif error.errno == errno.EACCES:
            reason = "needs the rights of an administrator; give a port of 1024 or more"
        else:
            raise _no_address(where, error) from None
        raise InputError(f"{where}: {reason}") from None
    listening.setblocking(False)
    return listening


def _no_address(where: str, error: Exception) -> InputError:
    return InputError(f"{where}: is no address of this machine ({error}); 0.0.0.0 means all of them")


def _list_names(host: str) -> tuple[str, ...]:
    """Names of this machine that links may have."""
    name = socket.gethostname()
    return ("localhost", host, name, f"{name}.local")


def _report_errors(app: "ASGIApp") -> "ASGIApp":
    """Hands exceptions, which are errors of the program, to the loop's handler; the server goes on."""

    async def guarded(scope: "Scope", receive: "Receive", send: "Send") -> None:
        try:
            await app(scope, receive, send)
        except Exception as error:
            message = f"the page's server cannot answer {scope['path']}"
            asyncio.get_running_loop().call_exception_handler({"message": message, "exception": error})
            raise

    return guarded


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
