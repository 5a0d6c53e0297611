"""What the page's server answers: the page and its files, pictures, the report, and a websocket."""

import asyncio
import time
from collections import Counter
from collections.abc import Callable, Coroutine, Mapping
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import Literal, Protocol, get_args

import numpy as np
from pydantic_core import to_json
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from calgraph.config.settings import PageSettings
from calgraph.live.job_queue import run_until_one_ends
from calgraph.live.state import Action, SessionState


class SessionView(Protocol):
    """A session as the page shows and commands it, all calls in one asyncio loop. None of them blocks."""

    def state(self) -> SessionState:
        """The session now."""

    def picture(self, sensor: str) -> bytes | None:
        """The view of a sensor with the board drawn in, a JPEG image; None before the first."""

    def report(self) -> Path | None:
        """The report of the calibration; None as long as there is none."""

    def command(self, action: Action) -> None:
        """Does what the operator wants."""


Refusal = Literal[
    "foreign hosts",
    "foreign origins",
    "missing tokens",
    "wrong tokens",
    "unknown commands",
    "oversized messages",
    "malformed messages",
    "commands in too fast succession",
    "pages beyond the limit",
    "connections beyond the limit",
    "requests that took too long",
    "malformed requests",
    "unknown addresses",
    "wrong methods",
]


class Refusals(Counter[Refusal]):
    """Counts by reason."""

    def describe(self) -> str:
        """One line, ``refused: 3 wrong tokens, 2 foreign origins``; empty where nothing was refused."""
        counts = ", ".join(f"{count} {reason}" for reason, count in self.most_common())
        return counts and f"refused: {counts}"


MEDIA_TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript"}
_ACTIONS: Mapping[object, Action] = {action: action for action in get_args(Action)}
# Of a message that a page sends: one word.
MAX_MESSAGE_BYTES = 64
# By close code of the protocol (RFC 6455, 7.4.1): beyond that, not a frame of the protocol, and text not in UTF-8.
_REFUSED: dict[int, Refusal] = {1009: "oversized messages", 1002: "malformed messages", 1007: "malformed messages"}
# The report has its scripts in it, and shows texts of the recording: it runs without access to this site.
_REPORT_POLICY = (
    "sandbox allow-scripts allow-downloads allow-modals; default-src 'none'; script-src 'unsafe-inline';"
    " style-src 'unsafe-inline'; img-src data: blob:; font-src data:; worker-src blob:; base-uri 'none';"
    " form-action 'none'; frame-ancestors 'none'"
)


# Rate at which the state is looked at for changes, which pages receive, Hz: as fast as a reader follows.
_RATE = 10.0
# Commands that a page may send in fast succession before the rate counts.
_COMMAND_BURST = 20
# Commands per second that a page may send on average: no finger is faster for long.
_COMMAND_RATE = 5.0


class PageApp:
    """Answers requests, counts what it refuses, and gives the state of the session to all pages that are open."""

    def __init__(self, view: SessionView, settings: PageSettings, refusals: Refusals) -> None:
        self._view = view
        self._settings = settings
        self._refusals = refusals
        self._pages = 0
        self.opened = 0
        """Number of pages that were ever open."""
        self._fields: Mapping[str, bytes] = {}
        self._changed = asyncio.Event()
        assets = [
            Route(f"/{'' if name == 'page.html' else name}", _answer_with(content, name))
            for name, content in _read_assets().items()
        ]
        self.routes = Starlette(
            routes=[
                *assets,
                Route("/picture", self._answer_picture),
                Route("/report", self._answer_report),
                WebSocketRoute("/state", self._serve_page),
            ]
        )
        self.routes.router.redirect_slashes = False

    async def follow(self) -> None:
        """Encodes the state again and again, and notes whether it has changed."""
        while True:
            fields = {name: _encode(value) for name, value in vars(self._view.state()).items()}
            if fields != self._fields:
                self._fields = fields
                self._changed.set()
                self._changed = asyncio.Event()
            await asyncio.sleep(1 / _RATE)

    async def _answer_picture(self, request: Request) -> Response:
        picture = self._view.picture(request.query_params.get("sensor", ""))
        if picture is None:
            raise HTTPException(404)
        return Response(picture, media_type="image/jpeg")

    async def _answer_report(self, _: Request) -> Response:
        report = self._view.report()
        if report is None:
            raise HTTPException(404)
        return FileResponse(report, media_type="text/html", headers={"Content-Security-Policy": _REPORT_POLICY})

    async def _serve_page(self, socket: WebSocket) -> None:
        if self._pages >= self._settings.max_pages:
            self._refusals["pages beyond the limit"] += 1
            await socket.close(1013)
            return
        self._pages += 1
        self.opened += 1
        try:
            await socket.accept()
            # The page is gone where it sends no more, and as good as gone where it accepts no more.
            await run_until_one_ends(self._send_states(socket), self._take_commands(socket))
        finally:
            self._pages -= 1

    async def _send_states(self, socket: WebSocket) -> None:
        """Sends what has changed since the last message, and an empty one where nothing has for a while.

        A page that is slow receives the newest state next, never those between.
        """
        sent: Mapping[str, bytes] = {}
        with suppress(TimeoutError, WebSocketDisconnect):
            while True:
                changed, current = self._changed, self._fields
                new = [
                    b'"%s":%s' % (name.encode(), text) for name, text in current.items() if sent.get(name) != text
                ]
                async with asyncio.timeout(self._settings.timeout):
                    await socket.send_text("{" + b",".join(new).decode() + "}")
                sent = current
                with suppress(TimeoutError):
                    await asyncio.wait_for(changed.wait(), self._settings.heartbeat)

    async def _take_commands(self, socket: WebSocket) -> None:
        """Hands commands to the session until the page is closed, or sends one that is refused."""
        allowed, since = float(_COMMAND_BURST), time.monotonic()
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                if refusal := _REFUSED.get(message.get("code", 0)):
                    self._refusals[refusal] += 1
                return
            now = time.monotonic()
            allowed = min(_COMMAND_BURST, allowed + (now - since) * _COMMAND_RATE)
            since = now
            action = _ACTIONS.get(message.get("text"))
            if action is None or allowed < 1:
                self._refusals["commands in too fast succession" if action else "unknown commands"] += 1
                await socket.close(1008)
                return
            allowed -= 1
            self._view.command(action)


def _encode(value: object) -> bytes:
    """A value as JSON; numbers that are not finite are null."""
    return to_json(value, inf_nan_mode="null", fallback=np.ndarray.tolist)


def _read_assets() -> Mapping[str, bytes]:
    """The files of the page by name."""
    found = [file for file in files("calgraph.live").iterdir() if file.name.rpartition(".")[2] in MEDIA_TYPES]
    return {file.name: file.read_bytes() for file in found}


def _answer_with(content: bytes, name: str) -> Callable[[Request], Coroutine[None, None, Response]]:
    async def answer(_: Request) -> Response:
        return Response(content, media_type=MEDIA_TYPES[name.rpartition(".")[2]])

    return answer
