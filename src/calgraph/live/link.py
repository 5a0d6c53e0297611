"""The link to the operator's page, and its QR code for a phone."""

import io
import ipaddress
import socket
from contextlib import suppress
from urllib.parse import urlencode

from calgraph.live.server import PageServer

# Of an address that needs not answer (RFC 5737): the way to it shows this machine's own address on the network.
_ANY_ADDRESS = {socket.AF_INET: "192.0.2.1", socket.AF_INET6: "2001:db8::1"}
_ANY_PORT = 9
# Modules of light around the code; readers of phones need two, the standard has four.
_BORDER = 2
# Colours by number, which themes of terminals do not change: light modules are drawn, dark ones are the ground.
_WHITE_ON_BLACK = "\x1b[38;5;231;48;5;16m"
_RESET = "\x1b[0m"


def format_link(server: PageServer, encoding: str = "utf-8") -> str:
    """Links to the page, and the QR code of the first one if other machines reach it.

    Args:
        server: of the page.
        encoding: of the terminal; without block characters in it there is no QR code.

    Returns:
        Lines for the terminal.
    """
    links = list_links(server)
    lines = [f"Open {links[0]}", *(f"  or {link}" for link in links[1:])]
    if server.token and (code := draw_qr_code(links[0])):
        with suppress(UnicodeEncodeError, LookupError):
            code.encode(encoding)
            lines.append(code)
    return "\n".join(lines)


def list_links(server: PageServer) -> list[str]:
    """Links to the page; of a server on all addresses of this machine, one for each that others may reach."""
    token = "?" + urlencode({"token": server.token}) if server.token else ""
    return [f"http://{_format_host(host)}:{server.port}/{token}" for host in _list_hosts(server.host)]


def draw_qr_code(text: str) -> str:
    """A QR code of half blocks, black on white in dark and light terminals; empty if segno is not installed."""
    try:
        import segno
    except ImportError:
        return ""
    drawn = io.StringIO()
    # The lowest error correction gives the smallest code: a screen has no scratches.
    segno.make(text, error="l", boost_error=False, micro=False).terminal(drawn, border=_BORDER, compact=True)
    return "\n".join(f"{_WHITE_ON_BLACK}{line}{_RESET}" for line in drawn.getvalue().splitlines())


def _list_hosts(host: str) -> list[str]:
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return [host]
    if not address.is_unspecified:
        return [host]
    families = [socket.AF_INET] if address.version == 4 else [socket.AF_INET6, socket.AF_INET]
    found = [own for family in families if (own := _find_own_address(family))]
    return [*found, socket.gethostname()]


def _find_own_address(family: socket.AddressFamily) -> str:
    """The address of the interface that has the default route; empty without one. Nothing is sent."""
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((_ANY_ADDRESS[family], _ANY_PORT))
        except OSError:
            return ""
        return str(probe.getsockname()[0])


def _format_host(host: str) -> str:
    return f"[{host}]" if ":" in host else host
