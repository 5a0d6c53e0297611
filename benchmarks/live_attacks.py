"""What programs of others may send to the page of a live session, and what they are answered."""

import http.client
import socket
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from urllib.parse import urlsplit

REPEATED = 20
"""How often each request is made."""
PATIENCE = 15.0
"""For an answer, s."""
TEXT, BINARY, RESERVED, CLOSE = 1, 2, 3, 8
"""Opcodes of frames (RFC 6455, section 5.2)."""
PATHS = (
    "/../../../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/..%2f..%2fetc%2fpasswd",
    "/page.css/../../access.py", "/report/../rig.yaml", "/recording/metadata.yaml",
    "/picture?sensor=../../etc/passwd", "/picture?sensor=camera%00", "/scene/..%5c..%5c", "/static/../page.html",
    "/.git/config",
)  # fmt: skip


@dataclass(frozen=True)
class Attack:
    """One kind of attack."""

    name: str
    count: int
    answer: str
    """Those that were received, with their number."""


class Target:
    """The server of a link, and the token in it.

    Args:
        link: that the command shows.
    """

    def __init__(self, link: str) -> None:
        parts = urlsplit(link)
        self.host, self._query = parts.netloc, parts.query
        self._address = parts.hostname or "", parts.port or 80
        self.cookie = ""
        self.cookie = self._ask(f"/?{self._query}")[1].split(";")[0]

    def get(self, path: str, method: str = "GET", cookie: str | None = None, **headers: str) -> str:
        """The status of an answer."""
        return self._ask(path, method, cookie, **headers)[0]

    def _ask(self, path: str, method: str = "GET", cookie: str | None = None, **headers: str) -> tuple[str, str]:
        connection = http.client.HTTPConnection(*self._address, timeout=PATIENCE)
        try:
            connection.putrequest(method, path, skip_host=True)
            for name, value in {
                "Host": self.host,
                "Cookie": self.cookie if cookie is None else cookie,
                **headers,
            }.items():
                connection.putheader(name, value)
            connection.endheaders()
            answer = connection.getresponse()
            return str(answer.status), answer.getheader("Set-Cookie", "")
        except (OSError, http.client.HTTPException):
            return "disconnected", ""
        finally:
            connection.close()

    def connect(self) -> socket.socket:
        """A connection."""
        return socket.create_connection(self._address, PATIENCE)

    def open_page(self, **headers: str) -> tuple[socket.socket, str]:
        """A websocket, and the status of its handshake."""
        given = {
            "Host": self.host, "Origin": f"http://{self.host}", "Cookie": self.cookie,
            "Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": "x" * 22 + "==", **headers,
        }  # fmt: skip
        opened = self.connect()
        lines = ["GET /state HTTP/1.1", *(f"{name}: {value}" for name, value in given.items() if value), "", ""]
        opened.sendall("\r\n".join(lines).encode())
        try:
            answer = b""
            while not answer.endswith(b"\r\n\r\n") and (more := opened.recv(1)):
                answer += more
            return opened, answer.decode(errors="replace").split(" ")[1]
        except (OSError, IndexError):
            return opened, "disconnected"

    def send_frames(self, *frames: bytes) -> str:
        """Sends frames through a page's websocket: the code with which it is closed."""
        opened, status = self.open_page()
        with opened:
            if status != "101":
                return status
            with suppress(OSError):
                for frame in frames:
                    opened.sendall(frame)
            return read_close_code(opened)

    def send_raw(self, content: bytes) -> str:
        """Sends anything: the status of the answer."""
        with self.connect() as opened:
            try:
                opened.sendall(content)
                answer = opened.recv(64).decode(errors="replace").split(" ")
            except OSError:
                return "disconnected"
            return answer[1] if len(answer) > 1 else "disconnected"


def make_frame(
    opcode: int, content: bytes, first: int = 0x80, length: int | None = None, *, masked: bool = True
) -> bytes:
    """A frame; with another length than its content has it is malformed."""
    size = len(content) if length is None else length
    short = size if size < 126 else 126 if size < 2**16 else 127
    extended = b"" if size < 126 else struct.pack(">H" if size < 2**16 else ">Q", size)
    mask = bytes(4) if masked else b""
    return bytes([first | opcode, (0x80 if masked else 0) | short]) + extended + mask + content


def read_close_code(opened: socket.socket) -> str:
    """The code with which the server closes a websocket; states that it sends before are skipped."""
    received = opened.makefile("rb")
    try:
        while head := received.read(2):
            opcode, short = head[0] & 15, head[1]
            extended = {126: 2, 127: 8}.get(short, 0)
            content = received.read(int.from_bytes(received.read(extended)) if extended else short)
            if opcode == CLOSE:
                return f"closed with {int.from_bytes(content[:2])}"
    except TimeoutError:
        return "still open"
    except OSError:
        pass
    return "disconnected"


def attack(link: str) -> list[Attack]:
    """Attacks the server of a link in all ways, one after another."""
    target = Target(link)

    def repeat(answer: Callable[[], str]) -> Iterator[str]:
        return (answer() for _ in range(REPEATED))

    def open_page(**headers: str) -> str:
        opened, status = target.open_page(**headers)
        opened.close()
        return status

    wrong, other = "calgraph-x=wrong", "http://evil.example"
    name = target.cookie.partition("=")[0]
    attacks: list[tuple[str, Iterable[str]]] = [
        ("wrong token in the link", repeat(lambda: target.get("/?token=wrong", cookie=""))),
        ("wrong token in the cookie", repeat(lambda: target.get("/", cookie=f"{name}=wrong"))),
        ("no token", repeat(lambda: target.get("/report", cookie=wrong))),
        ("websocket without token", repeat(lambda: open_page(Cookie=""))),
        ("websocket of a foreign page", repeat(lambda: open_page(Origin=other))),
        ("websocket without Origin", repeat(lambda: open_page(Origin=""))),
        ("foreign Host", repeat(lambda: target.get("/", Host="evil.example"))),
        ("websocket with a foreign Host", repeat(lambda: open_page(Host="evil.example", Origin=other))),
        ("paths out of the page's files", map(target.get, PATHS)),
        ("methods that change files", (target.get("/page.js", one) for one in ("POST", "PUT", "DELETE", "PATCH"))),
        ("malformed requests", map(target.send_raw, (b"\x16\x03\x01\x02\r\n\r\n", b"GET / HTTP/9\r\n\r\n"))),
        ("header of 1 MB", repeat(lambda: target.send_raw(b"GET / HTTP/1.1\r\nA: " + b"a" * 2**20))),
        ("frame of 1 MB", repeat(lambda: target.send_frames(make_frame(TEXT, bytes(2**20))))),
        ("frame that claims 2^62 bytes", repeat(lambda: target.send_frames(make_frame(TEXT, b"", length=2**62)))),
        ("frame of a reserved kind", repeat(lambda: target.send_frames(make_frame(RESERVED, b"a")))),
        ("frame with reserved bits", repeat(lambda: target.send_frames(make_frame(TEXT, b"a", first=0xF0)))),
        ("frame without mask", repeat(lambda: target.send_frames(make_frame(TEXT, b"a", masked=False)))),
        ("text that is not UTF-8", repeat(lambda: target.send_frames(make_frame(TEXT, b"\xff\xfe")))),
        ("unknown commands", repeat(lambda: target.send_frames(make_frame(TEXT, b"rm -rf /")))),
        ("binary frames", repeat(lambda: target.send_frames(make_frame(BINARY, b"finish")))),
        ("commands without end", (target.send_frames(*[make_frame(TEXT, b"automatic")] * 200) for _ in range(1))),
        ("9 pages more", open_pages(target, 9)),
        ("80 connections that send nothing", idle(target, 80, b"")),
        ("5 requests that do not end", idle(target, 5, b"GET / HTTP/1.1\r\nHost: ")),
    ]  # fmt: skip
    found = []
    for kind, answers in attacks:
        counts = Counter(answers)
        text = ", ".join(
            f"{answer} ({count})" if len(counts) > 1 else answer for answer, count in counts.most_common()
        )
        found.append(Attack(kind, counts.total(), text))
    return found


def open_pages(target: Target, count: int) -> Iterator[str]:
    """Pages that stay open together."""
    with ExitStack() as stack:
        for _ in range(count):
            opened, status = target.open_page()
            stack.enter_context(opened)
            yield status


def idle(target: Target, count: int, content: bytes) -> Iterator[str]:
    """Connections that stay open together, until the server closes them."""
    with ExitStack() as stack:
        opened = []
        for _ in range(count):
            with suppress(OSError):
                opened.append(stack.enter_context(target.connect()))
                opened[-1].sendall(content)
        began = time.monotonic()
        for one in opened:
            try:
                one.settimeout(max(0.1, began + PATIENCE - time.monotonic()))
                ended = one.recv(64) == b""
            except TimeoutError:
                ended = False
            except OSError:
                ended = True
            yield f"disconnected after {time.monotonic() - began:.0f} s" if ended else "still open"
