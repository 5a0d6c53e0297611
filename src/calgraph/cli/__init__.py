"""The command line: parse, call, print."""

from calgraph.cli.launcher import main

__all__ = ["main"]
