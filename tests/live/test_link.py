"""Links to the page, and their QR codes."""

import re
import socket

import cv2
import numpy as np
import pytest

from calgraph.live.link import draw_qr_code, format_link, list_links
from calgraph.live.page_app import Refusals
from calgraph.live.server import PageServer


def server(host: str, token: str | None = "secret-token_1") -> PageServer:
    return PageServer(host, 8790, token, Refusals(), lambda: 0)


def read_blocks(text: str) -> str:
    """What a phone reads of a code of half blocks, white on black."""
    assert text.startswith("\x1b[38;5;231;48;5;16m")
    halves = {" ": (0, 0), "▀": (1, 0), "▄": (0, 1), "█": (1, 1)}
    lines = re.sub("\x1b[^m]*m", "", text).split("\n")
    rows = [[halves[block] for block in line] for line in lines]
    modules = np.array(rows, dtype=np.uint8).transpose(0, 2, 1).reshape(2 * len(rows), -1)
    picture = np.kron(255 * modules, np.ones((8, 8), dtype=np.uint8))
    return str(cv2.QRCodeDetector().detectAndDecode(np.pad(picture, 32, constant_values=255))[0])


def test_the_link_of_this_machine_alone_needs_neither_token_nor_code() -> None:
    assert format_link(server("127.0.0.1", None)) == "Open http://127.0.0.1:8790/"


def test_links_to_all_addresses_have_the_token_and_the_name_of_this_machine() -> None:
    links = list_links(server("0.0.0.0"))
    assert links[-1] == f"http://{socket.gethostname()}:8790/?token=secret-token_1"
    assert not any("0.0.0.0" in link for link in links)


def test_addresses_of_version_6_have_brackets() -> None:
    assert list_links(server("fe80::2")) == ["http://[fe80::2]:8790/?token=secret-token_1"]


def test_the_code_has_the_link() -> None:
    pytest.importorskip("segno")
    link = list_links(server("192.168.1.7"))[0]
    assert read_blocks(draw_qr_code(link)) == link


def test_terminals_without_blocks_show_the_link_alone() -> None:
    assert format_link(server("192.168.1.7"), "ascii") == "Open http://192.168.1.7:8790/?token=secret-token_1"
