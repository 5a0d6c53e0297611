"""The entry point of the command line; it imports nothing, so that an interruption of imports is handled."""


def main() -> None:
    """Runs the command given; exit code 0, 1 (not calibrated) or 2 (bad usage or input)."""
    try:
        from calgraph.cli.app import run_command_line

        run_command_line()
    except KeyboardInterrupt:
        # While the modules of a command are loaded, or while it ends: as by app.handle_errors.
        raise SystemExit(128 + 2) from None
