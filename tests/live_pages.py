"""A session with given states, and its page served in a thread."""

import asyncio
import http.client
import queue
import threading
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import Self

from calgraph.config.settings import PageSettings
from calgraph.live.server import PageServer, serve_page
from calgraph.live.state import Action, SessionState

PATIENCE = 30.0
"""s; long enough for any machine, and waited in failing tests only."""


class GivenSession:
    """Shows what it is given, and keeps the commands."""

    def __init__(self, state: SessionState) -> None:
        self._state = state
        self.encoded = 0
        """How often the state was asked for."""
        self.pictures: dict[str, bytes] = {}
        self.report_file: Path | None = None
        self.commands: queue.Queue[str] = queue.Queue()

    def state(self) -> SessionState:
        self.encoded += 1
        return self._state

    def picture(self, sensor: str) -> bytes | None:
        return self.pictures.get(sensor)

    def report(self) -> Path | None:
        return self.report_file

    def command(self, action: Action) -> None:
        self.commands.put(action)

    def show(self, state: SessionState) -> None:
        """From now on this is the state; from any thread."""
        self._state = state

    def next_command(self) -> str:
        return self.commands.get(timeout=PATIENCE)


class ServedPage(AbstractContextManager["ServedPage"]):
    """The page of a session on a free port, until the context ends."""

    def __init__(
        self, session: GivenSession, host: str = "127.0.0.1", port: int = 0, settings: PageSettings | None = None
    ) -> None:
        self.session = session
        self._arguments = (host, port, settings or PageSettings())
        self._started = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()), daemon=True)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._end: asyncio.Event | None = None
        self._error: BaseException | None = None
        self._server: PageServer | None = None

    @property
    def server(self) -> PageServer:
        assert self._server
        return self._server

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self.server.port}"

    @property
    def url(self) -> str:
        return f"http://{self.address}/"

    @property
    def link(self) -> str:
        token = self.server.token
        return f"{self.url}?token={token}" if token else self.url

    def get(self, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
        """Status, headers and content, of a path that is sent as it is."""
        connection = http.client.HTTPConnection(self.address, timeout=PATIENCE)
        try:
            connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
            for name, value in {"Host": self.address, **headers}.items():
                connection.putheader(name, value)
            connection.endheaders()
            answer = connection.getresponse()
            return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
        finally:
            connection.close()

    def __enter__(self) -> Self:
        self._thread.start()
        assert self._started.wait(PATIENCE)
        if self._error:
            raise self._error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._loop
        assert self._end
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive()
        if self._error:
            raise self._error

    async def _serve(self) -> None:
        self._loop, self._end = asyncio.get_running_loop(), asyncio.Event()
        host, port, settings = self._arguments
        try:
            async with serve_page(self.session, host, port, settings=settings) as self._server:
                self._started.set()
                await self._end.wait()
        except BaseException as error:
            self._error = error
        finally:
            self._started.set()
