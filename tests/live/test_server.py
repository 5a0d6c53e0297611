"""The server of the page: who gets what, and what is refused and counted."""

import json
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.sync.connection import Connection
from websockets.typing import Origin

from calgraph.config.settings import PageSettings
from calgraph.errors import InputError
from calgraph.live.page_app import Refusal
from calgraph.live.state import SensorState, SessionState
from live_pages import PATIENCE, GivenSession, ServedPage

SENSORS = (SensorState("camera", "camera", stddev_mm=float("nan")), SensorState("a/../b", "lidar2d"))
STATE = SessionState("rig", "ready", "Hold the board still", "replay", sensors=SENSORS)


@pytest.fixture(scope="module")
def local() -> Iterator[ServedPage]:
    """Served to this machine alone."""
    with ServedPage(GivenSession(STATE)) as page:
        yield page


@pytest.fixture(scope="module")
def public() -> Iterator[ServedPage]:
    """Served to a network."""
    with ServedPage(GivenSession(STATE), host="0.0.0.0") as page:
        yield page


def open_socket(page: ServedPage, cookie: str = "", **changes: str) -> ClientConnection:
    headers = {"Cookie": cookie} if cookie else {}
    origin = Origin(changes.get("origin", f"http://{page.address}"))
    return connect(
        f"ws://{page.address}/state", origin=origin, additional_headers=headers, open_timeout=PATIENCE, proxy=None
    )


def cookie_of(page: ServedPage) -> str:
    _, headers, _ = page.get(f"/?token={page.server.token}")
    return headers["set-cookie"].split(";")[0]


def count(page: ServedPage, reason: Refusal) -> int:
    return page.server.refusals[reason]


def test_page_and_its_files_are_served_with_headers_that_allow_own_files_only(local: ServedPage) -> None:
    status, headers, content = local.get("/")
    assert status == 200
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy
    assert "unsafe" not in policy
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] == "no-referrer"
    named = re.findall(r'(?:src|href)="(/[^"]+[.][a-z]+)"', content.decode())
    assert {local.get(name)[0] for name in named} == {200}


def test_a_page_receives_the_state_and_then_what_has_changed(local: ServedPage) -> None:
    with open_socket(local) as page:
        first = json.loads(page.recv(timeout=PATIENCE))
        assert first["headline"] == "Hold the board still"
        assert first["sensors"][0]["stddev_mm"] is None
        local.session.show(replace(STATE, captures=7))
        later: dict[str, object] = {}
        while not later:
            later = json.loads(page.recv(timeout=PATIENCE))
    assert later == {"captures": 7}


def test_a_page_receives_an_empty_message_where_nothing_changes() -> None:
    with (
        ServedPage(GivenSession(STATE), settings=PageSettings(heartbeat=0.05)) as served,
        open_socket(served) as page,
    ):
        page.recv(timeout=PATIENCE)
        assert [page.recv(timeout=PATIENCE) for _ in range(3)] == ["{}"] * 3


def test_changes_beyond_the_rate_are_merged_and_the_last_one_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.live.page_app._RATE", 4)
    with ServedPage(GivenSession(STATE)) as served, open_socket(served) as page:
        json.loads(page.recv(timeout=PATIENCE))
        for number in range(1, 1001):
            served.session.show(replace(STATE, captures=number))
        received: list[int | None] = []
        while received[-1:] != [1000]:
            received.append(json.loads(page.recv(timeout=PATIENCE)).get("captures"))
    assert len(received) < 20
    assert served.session.encoded < 40


def test_a_page_that_reads_nothing_is_closed_and_delays_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.live.page_app._RATE", 1000)
    settings = PageSettings(timeout=0.5, max_pages=2)
    with ServedPage(GivenSession(STATE), settings=settings) as served:
        stuck = socket.create_connection(("127.0.0.1", served.server.port), timeout=PATIENCE)
        stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        lines = [
            "GET /state HTTP/1.1", f"Host: {served.address}", f"Origin: http://{served.address}",
            "Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13",
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
        ]  # fmt: skip
        stuck.sendall("\r\n".join([*lines, "", ""]).encode())
        with open_socket(served) as page:
            for number in range(1, 60):
                served.session.show(replace(STATE, root=str(number) * 100_000))
                while "root" not in json.loads(page.recv(timeout=PATIENCE)):
                    pass
            with stuck, open_when_allowed(served) as another:
                assert another.recv(timeout=PATIENCE)


def open_when_allowed(page: ServedPage) -> ClientConnection:
    """Opens the page once another one is closed."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        with suppress(InvalidStatus):
            return open_socket(page)
        time.sleep(0.05)
    raise AssertionError("no page was closed")


def is_closed(connection: socket.socket) -> bool:
    """Whether the other side has closed a connection, after what it has sent before."""
    with suppress(ConnectionResetError):
        while connection.recv(1 << 20):
            pass
    return True


@pytest.mark.parametrize("action", ["trigger", "automatic", "manual", "discard", "finish"])
def test_commands_reach_the_session(local: ServedPage, action: str) -> None:
    with open_socket(local) as page:
        page.send(action)
        assert local.session.next_command() == action


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        ("shutdown", "unknown commands"),
        ("", "unknown commands"),
        ("trigger\n", "unknown commands"),
        ('{"action": "trigger"}', "unknown commands"),
        (b"trigger", "unknown commands"),
        ("x" * 65, "oversized messages"),
        ("x" * 1_000_000, "oversized messages"),
    ],
)
def test_other_messages_are_refused(local: ServedPage, message: str | bytes, reason: Refusal) -> None:
    before = count(local, reason)
    with open_socket(local) as page:
        with pytest.raises(ConnectionClosed):
            send_until_closed(page, message)
        assert count(local, reason) == before + 1
    assert local.session.commands.empty()


@pytest.mark.parametrize(
    "frame",
    [b"\x83\x80\0\0\0\0", b"\xf1\x80\0\0\0\0", b"\x81\x01a", b"\x81\x82\0\0\0\0\xff\xfe"],
    ids=["reserved opcode", "reserved bits", "no mask", "no UTF-8"],
)
def test_frames_that_violate_the_protocol_are_refused(local: ServedPage, frame: bytes) -> None:
    before = count(local, "malformed messages")
    with open_socket(local) as page:
        page.socket.sendall(frame)
        with pytest.raises(ConnectionClosed):
            receive_until_closed(page)
        assert count(local, "malformed messages") == before + 1


def send_until_closed(page: Connection, message: str | bytes) -> None:
    page.send(message)
    receive_until_closed(page)


def receive_until_closed(page: Connection) -> None:
    while True:
        page.recv(timeout=PATIENCE)


def test_commands_in_too_fast_succession_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.live.page_app._COMMAND_BURST", 3)
    monkeypatch.setattr("calgraph.live.page_app._COMMAND_RATE", 1e-3)
    with ServedPage(GivenSession(STATE)) as served, open_socket(served) as page:
        for _ in range(3):
            page.send("trigger")
        with pytest.raises(ConnectionClosed):
            send_until_closed(page, "trigger")
        assert served.session.commands.qsize() == 3
        assert served.server.refusals.describe() == "refused: 1 commands in too fast succession"


def test_pages_beyond_the_limit_are_refused_until_one_is_closed() -> None:
    with ServedPage(GivenSession(STATE), settings=PageSettings(max_pages=1)) as served:
        with open_socket(served) as first:
            first.recv(timeout=PATIENCE)
            with pytest.raises(InvalidStatus):
                open_socket(served)
        assert count(served, "pages beyond the limit") == 1
        with open_when_allowed(served) as second:
            assert second.recv(timeout=PATIENCE)


def test_connections_beyond_the_limit_and_idle_ones_are_closed() -> None:
    settings = PageSettings(max_connections=2, timeout=0.3)
    with ServedPage(GivenSession(STATE), settings=settings) as served:
        idle = [socket.create_connection(("127.0.0.1", served.server.port), timeout=PATIENCE) for _ in range(3)]
        for one in idle:
            with one:
                assert is_closed(one)
        assert (count(served, "connections beyond the limit"), count(served, "requests that took too long")) == (
            1,
            2,
        )
        assert served.get("/")[0] == 200


@pytest.mark.parametrize("request_bytes", [b"\x16\x03\x01\r\n\r\n", b"GET / HTTP/9\r\n\r\n"])
def test_requests_that_are_none_of_http_are_refused(local: ServedPage, request_bytes: bytes) -> None:
    before = count(local, "malformed requests")
    with socket.create_connection(("127.0.0.1", local.server.port), timeout=PATIENCE) as connection:
        connection.sendall(request_bytes)
        assert connection.recv(12) == b"HTTP/1.1 400"
    assert count(local, "malformed requests") == before + 1


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "127.0.0.2x", "192.168.0.7", "", "a b"]
)
def test_foreign_hosts_are_refused(local: ServedPage, host: str) -> None:
    before = count(local, "foreign hosts")
    status, headers, _ = local.get("/", Host=host)
    assert status == 421
    assert host not in headers["content-security-policy"] or not host
    assert count(local, "foreign hosts") == before + 1


@pytest.mark.parametrize("host", ["localhost:9000", "[::1]:80", "127.0.0.1", "LOCALHOST"])
def test_names_of_this_machine_are_accepted(local: ServedPage, host: str) -> None:
    assert local.get("/", Host=host)[0] == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1", "https://ADDRESS", ""])
def test_websockets_of_foreign_origins_are_refused(local: ServedPage, origin: str) -> None:
    before = count(local, "foreign origins")
    with pytest.raises(InvalidStatus):
        open_socket(local, origin=origin.replace("ADDRESS", local.address))
    assert count(local, "foreign origins") == before + 1


def test_a_network_needs_the_token_of_the_link(public: ServedPage) -> None:
    assert [public.get(path)[0] for path in ("/", "/picture?sensor=camera", "/report", "/page.js")] == [403] * 4
    with pytest.raises(InvalidStatus):
        open_socket(public)
    assert count(public, "missing tokens") == 5


def test_the_link_sets_a_cookie_that_opens_everything(public: ServedPage) -> None:
    status, headers, content = public.get(f"/?token={public.server.token}")
    assert (status, headers["refresh"]) == (200, "0; url=/")
    # Otherwise browsers ask for one, which is not there.
    assert b'<link rel="icon" href="data:,">' in content
    assert {"HttpOnly", "SameSite=strict"} <= set(headers["set-cookie"].split("; "))
    assert public.get("/", Cookie=cookie_of(public))[0] == 200
    with open_socket(public, cookie_of(public)) as page:
        assert page.recv(timeout=PATIENCE)


@pytest.mark.parametrize("token", ["", "x", "%00", "%ff", "%C3%A9"])
def test_wrong_tokens_are_refused(public: ServedPage, token: str) -> None:
    before = count(public, "wrong tokens")
    name = cookie_of(public).split("=")[0]
    assert public.get(f"/?token={token}")[0] == 403
    assert public.get("/", Cookie=f"{name}=x{token}é")[0] == 403
    with pytest.raises(InvalidStatus):
        open_socket(public, f"{name}=x")
    assert count(public, "wrong tokens") >= before + 2


def test_tokens_are_random() -> None:
    with ServedPage(GivenSession(STATE), "0.0.0.0") as one, ServedPage(GivenSession(STATE), "0.0.0.0") as other:
        assert len({one.server.token, other.server.token}) == 2
        assert len(one.server.token or "") >= 20


def test_pictures_are_those_of_sensors_and_nothing_else(local: ServedPage, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("secret")
    local.session.pictures = {"a/../b": b"\xff\xd8jpeg"}
    status, headers, content = local.get("/picture?sensor=a%2F..%2Fb")
    assert (status, headers["content-type"], content) == (200, "image/jpeg", b"\xff\xd8jpeg")
    before = count(local, "unknown addresses")
    tricks = [
        f"/picture?sensor={tmp_path}/secret", "/picture?sensor=../../etc/passwd", "/picture", "/../../etc/passwd",
        "/..%2f..%2fetc%2fpasswd", "//etc/passwd", "/page.js/../server.py", "/server.py", "/page.html%00",
        "/scene", "/report/../server.py", "/picture/",
    ]  # fmt: skip
    assert [local.get(trick)[0] for trick in tricks] == [404] * len(tricks)
    assert count(local, "unknown addresses") == before + len(tricks)


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS"])
def test_other_methods_are_refused(local: ServedPage, method: str) -> None:
    assert local.get("/", method)[0] == 405


def test_the_report_is_served_without_access_to_the_page(local: ServedPage, tmp_path: Path) -> None:
    local.session.report_file = tmp_path / "report.html"
    local.session.report_file.write_text("<p>report")
    status, headers, content = local.get("/report")
    assert (status, content) == (200, b"<p>report")
    policy = headers["content-security-policy"]
    assert policy.startswith("sandbox allow-scripts")
    assert "allow-same-origin" not in policy
    assert "connect-src" not in policy


def test_malformed_requests_are_answered_and_end_nothing(local: ServedPage) -> None:
    for request in (b"\x16\x03\x01\x00\x01", b"GET / HTTP/1.1\r\n\r\n", b"GET " + b"a" * 100_000):
        with socket.create_connection(("127.0.0.1", local.server.port), timeout=PATIENCE) as raw:
            raw.sendall(request)
            raw.shutdown(socket.SHUT_WR)
            while raw.recv(65_536):
                pass
    assert local.get("/")[0] == 200


def test_a_port_in_use_is_an_input_error(local: ServedPage) -> None:
    port = local.server.port
    with pytest.raises(InputError, match=f"`port` {port}: another program listens on that port; give another one"):
        ServedPage(GivenSession(STATE), port=port).__enter__()


@pytest.mark.parametrize("host", ["203.0.113.7", "no such host"])
def test_an_address_of_another_machine_is_an_input_error(host: str) -> None:
    with pytest.raises(InputError, match=f"`host` {host}, `port` 0: is no address of this machine"):
        ServedPage(GivenSession(STATE), host).__enter__()


@pytest.mark.parametrize("library", ["starlette", "uvicorn", "websockets"])
def test_without_the_extra_the_command_that_installs_it_is_named(library: str) -> None:
    code = f"import sys; sys.modules[{library!r}] = None; from calgraph.cli import main; main()"
    command = [sys.executable, "-c", code, "live"]
    ended = subprocess.run(command, check=False, capture_output=True, text=True, timeout=PATIENCE)
    assert ended.returncode == 2
    assert "pip install 'calgraph[live]'" in ended.stderr
