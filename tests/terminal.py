"""What programs show on a terminal of 80 columns, in tests."""

import os
import pty
import re
import struct
import subprocess
import sys
import termios
from fcntl import ioctl


def on_a_terminal(code: str) -> list[str]:
    """The lines that a program shows on a terminal of 80 columns, without colours."""
    return re.sub(r"\x1b\[[0-9;]*m", "", sent_to_a_terminal(code)).splitlines()


def sent_to_a_terminal(code: str) -> str:
    """All that a program sends to a terminal of 80 columns, control sequences included."""
    parent, child = pty.openpty()
    ioctl(child, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    environment = {k: v for k, v in os.environ.items() if k not in ("COLUMNS", "NO_COLOR")} | {"TERM": "xterm"}
    with subprocess.Popen([sys.executable, "-c", code], stdout=child, stderr=child, env=environment) as process:
        os.close(child)
        shown = b""
        try:
            while part := os.read(parent, 65536):
                shown += part
        except OSError:  # how Linux tells that the other side has closed
            pass
        process.wait(timeout=120)
    os.close(parent)
    return shown.decode()
