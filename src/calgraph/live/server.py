"""The server of the operator's page, in the asyncio loop of the session."""

import asyncio
import errno
import ipaddress
import re
import secrets
import socket
from collections.abc import AsyncIterator, Callable, Collection
from contextlib import asynccontextmanager, nullcontext
from dataclasses import dataclass

from calgraph.config.settings import PageSettings
from calgraph.errors import InputError

try:
    import uvicorn
    import websockets  # noqa: F401  # of uvicorn
    from starlette.datastructures import MutableHeaders
    from starlette.requests import HTTPConnection
    from starlette.responses import HTMLResponse, Response
    from starlette.types import ASGIApp, Message, Receive, Scope, Send
    from uvicorn.protocols.http.h11_impl import H11Protocol

    from calgraph.live.page_app import MAX_MESSAGE_BYTES, PageApp, Refusal, Refusals, SessionView
except ImportError:
    raise InputError(
        "live capture needs starlette, uvicorn and websockets, which are not installed:"
        " pip install 'calgraph[live]'"
    ) from None

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
        InputError: the address cannot be used.
    """
    listening = _listen(host, port, settings)
    address, port, *_ = listening.getsockname()
    refusals = Refusals()
    is_local = ipaddress.ip_address(address.partition("%")[0]).is_loopback
    token = None if is_local else secrets.token_urlsafe(_TOKEN_BYTES)
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
    serving, following = asyncio.create_task(server.serve([listening])), asyncio.create_task(app.follow())
    try:
        yield PageServer(host, port, token, refusals, lambda: app.opened)
    finally:
        server.should_exit = True
        following.cancel()
        await asyncio.wait([serving, following])


def _listen(host: str, port: int, settings: PageSettings) -> socket.socket:
    """A socket that listens; other programs on the port are refused, those just ended are not."""
    where = f"`host` {host}, `port` {port}"
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        is_dual = family == socket.AF_INET6 and socket.has_dualstack_ipv6()
        listening = socket.create_server(
            address, family=family, backlog=settings.max_connections, dualstack_ipv6=is_dual
        )
    except (OSError, UnicodeError) as error:
        number = getattr(error, "errno", None)
        if number == errno.EADDRINUSE:
            reason = "another program listens on that port; give another one, or 0 for any that is free"
        elif number == errno.EACCES:
            reason = "needs the rights of an administrator; give a port of 1024 or more"
        else:
            reason = f"is no address of this machine ({error}); 0.0.0.0 means all of them"
        raise InputError(f"{where}: {reason}") from None
    if hasattr(socket, "TCP_USER_TIMEOUT"):
        # Otherwise Linux keeps connections to phones that are out of reach for a quarter of an hour.
        milliseconds = round(settings.timeout * _MS_PER_SECOND)
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, milliseconds)
    listening.setblocking(False)
    return listening


def _list_names(host: str) -> tuple[str, ...]:
    """Names of this machine that links may have."""
    name = socket.gethostname()
    return tuple(one.lower() for one in ("localhost", host, name, f"{name}.local"))


def _report_errors(app: ASGIApp) -> ASGIApp:
    """Hands exceptions, which are errors of the program, to the loop's handler; the server goes on."""

    async def guarded(scope: Scope, receive: Receive, send: Send) -> None:
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
                refusals["connections beyond the limit"] += 1
                transport.abort()
            else:
                self._deadline = self.loop.call_later(settings.timeout, self._end_without_request)

        def connection_lost(self, exc: Exception | None) -> None:
            if self._deadline:
                self._deadline.cancel()
            super().connection_lost(exc)

        def send_400_response(self, msg: str) -> None:
            refusals["malformed requests"] += 1
            super().send_400_response(msg)

        def _end_without_request(self) -> None:
            # A websocket has another protocol by now.
            if self.cycle is None and self.transport.get_protocol() is self:
                refusals["requests that took too long"] += 1
                self.transport.abort()

    return BoundedProtocol


_HOST = re.compile(r"(?P<name>\[[0-9a-fA-F:.]+\]|[A-Za-z0-9.-]+)(?::[0-9]{1,5})?")
# Bytes of randomness, more than can be tried.
_TOKEN_BYTES = 16
# For phones, in letters that are large without a style sheet; browsers ask for no icon where one is given.
_DOCUMENT = (
    '<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    '<meta name="color-scheme" content="dark"><link rel="icon" href="data:,"><title>calgraph live</title>{}'
    "</html>\n"
)
_OLD_LINK = "This link is not valid any more: open the one that calgraph live shows now."


@dataclass(frozen=True, eq=False)
class AccessCheck:
    """Refuses requests that do not come from the page itself, and counts them.

    A page of another site may make a browser send requests here: by a name that it lets point to this machine (DNS
    rebinding), which the header Host reveals, or by a websocket, which Origin reveals.

    """

    app: ASGIApp
    """Answers what is allowed."""
    token: str | None
    """That the link has; None if only this machine reaches the server."""
    names: Collection[str]
    """Of hosts in lower case, besides literal addresses, which cannot be rebound."""
    cookie: str
    """Name of the cookie that keeps the token."""
    refusals: Refusals
    """Are counted here."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answers a request, or lets the application answer it."""
        request = HTTPConnection(scope)
        host = request.headers.get("host", "")

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                self._count_status(message["status"])
                known = host if self._is_known(host) else ""
                _add_headers(MutableHeaders(scope=message), known, is_local=self.token is None)
            await send(message)

        refusal, answer = self._check(request, host)
        if refusal:
            self.refusals[refusal] += 1
        if answer is None:
            await self.app(scope, receive, send_guarded)
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008})
        else:
            await answer(scope, receive, send_guarded)

    def _check(self, request: HTTPConnection, host: str) -> tuple[Refusal | None, Response | None]:
        """The reason of a refusal, and the answer that replaces the application's."""
        if not self._is_known(host):
            return "foreign hosts", _refuse("This address is not that of calgraph live.", 421)
        is_websocket = request.scope["type"] == "websocket"
        if is_websocket and request.headers.get("origin") != f"http://{host}":
            return "foreign origins", _refuse("", 403)
        if self.token is None:
            return None, None
        given = request.query_params.get("token") if request.scope["path"] == "/" else None
        if given is not None and not is_websocket:
            if _is_token(given, self.token):
                return None, self._admit()
            return "wrong tokens", _refuse(_OLD_LINK, 403)
        kept = request.cookies.get(self.cookie)
        if kept is None:
            return "missing tokens", _refuse("Open the link with the token that calgraph live shows.", 403)
        if not _is_token(kept, self.token):
            return "wrong tokens", _refuse(_OLD_LINK, 403)
        return None, None

    def _is_known(self, host: str) -> bool:
        match = _HOST.fullmatch(host)
        if not match:
            return False
        name = match["name"].lower()
        try:
            address = ipaddress.ip_address(name.strip("[]"))
        except ValueError:
            return name in self.names
        return self.token is not None or address.is_loopback

    def _admit(self) -> Response:
        # A redirect would be part of the navigation to the link: where that began on a page of another site, such
        # as a chat, browsers send no cookie that is SameSite=Strict. A refresh begins here.
        response = HTMLResponse(_DOCUMENT.format(""), headers={"Refresh": "0; url=/"})
        response.set_cookie(self.cookie, self.token or "", httponly=True, samesite="strict", path="/")
        return response

    def _count_status(self, status: int) -> None:
        if status == 404:
            self.refusals["unknown addresses"] += 1
        elif status == 405:
            self.refusals["wrong methods"] += 1


def _is_token(given: str, token: str) -> bool:
    """In a time that does not depend on how many characters are right."""
    return secrets.compare_digest(given.encode("utf-8", "surrogateescape"), token.encode())


def _refuse(text: str, status: int) -> Response:
    return HTMLResponse(_DOCUMENT.format(f"<h1>{text}</h1>"), status, {"Connection": "close"})


def _add_headers(headers: MutableHeaders, host: str, *, is_local: bool) -> None:
    """Own files only: no script in the page, no other site, no frame around it, no copy that stays."""
    # Safari before 15.4 does not count websockets as 'self'.
    sockets = f" ws://{host}" if host else ""
    policy = (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:;"
        f" connect-src 'self'{sockets}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    headers.setdefault("Content-Security-Policy", policy)
    headers["X-Content-Type-Options"] = "nosniff"
    headers["X-Frame-Options"] = "DENY"
    headers["Referrer-Policy"] = "no-referrer"
    headers["Cross-Origin-Resource-Policy"] = "same-origin"
    headers["Cache-Control"] = "no-store"
    if is_local:
        # Browsers heed it for https and their own machine; from others it is an error in their console.
        headers["Cross-Origin-Opener-Policy"] = "same-origin"
