"""The entry point of the command line; it imports little, so that signals are handled before the rest is."""

from calgraph.termination import handle_signals


def main() -> None:
    """Runs the command given; exit code 0, 1 (not calibrated) or 2 (bad usage or input)."""
    handle_signals()
    from calgraph.cli.app import run_command_line

    run_command_line()
