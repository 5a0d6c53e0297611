"""How many processes share the work."""

import os
from typing import Annotated

import typer

JobsOption = Annotated[
    int | None,
    typer.Option("--jobs", min=1, help="People: share the work among so many processes; all cores if left out."),
]


def cores() -> int:
    """The processors that this process may use."""
    # A container or a batch system may grant fewer than the machine has.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
