"""The option ``--verbose``: each step of the work on stderr, with counts and times."""

import logging
import time
from typing import Annotated

import typer

VerboseOption = Annotated[
    bool, typer.Option("--verbose", "-v", help="Log each step with counts and times on stderr.")
]


def log_steps() -> None:
    """Shows what is logged from now on, each line with the time since then."""
    began = time.time()

    def add_time(record: logging.LogRecord) -> bool:
        record.since = record.created - began
        return True

    handler = logging.StreamHandler()
    handler.addFilter(add_time)
    handler.setFormatter(logging.Formatter("calgraph: %(since)6.1f s  %(message)s"))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.INFO)
