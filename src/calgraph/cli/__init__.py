"""The command line: parse, call, print."""

from calgraph.cli.app import main

__all__ = ["main"]
