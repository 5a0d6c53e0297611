"""The entry point of the command line; it imports little, so that signals are handled before the rest is."""

import sys

from calgraph.io.termination import handle_signals

_MIN_ADDRESS_SPACE = 10**9
"""Of all modules of a command and a small recording, which need some 700 MB, with a margin for several processes,
bytes. With less, libraries end the program themselves, or never: some try again and again to get memory."""


def main() -> None:
    """Runs the command given; exit code 0, 1 (not calibrated) or 2 (bad usage or input)."""
    handle_signals()
    limit = _find_memory_limit()
    if limit is not None and limit < _MIN_ADDRESS_SPACE:
        # As a CalibrationError is printed, whose printing needs more memory.
        sys.exit(
            f"calgraph: memory is limited to {limit / 1e6:.0f} MB (ulimit -v); at least "
            f"{_MIN_ADDRESS_SPACE / 1e6:.0f} MB are needed"
        )
    from calgraph.cli.app import run_command_line

    run_command_line()


def _find_memory_limit() -> int | None:
    """The limit of the address space of this process, bytes; None if there is none."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit == resource.RLIM_INFINITY else limit
