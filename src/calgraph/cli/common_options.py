"""Arguments and options that mean the same to several commands."""

import os
from pathlib import Path
from typing import Annotated

import typer

RigFile = Annotated[Path, typer.Argument(metavar="RIG.yaml", help="Sensors, target and captures.")]
OneRecording = Annotated[Path, typer.Argument(metavar="RECORDING", help="Anything that calibrate reads.")]
Results = Annotated[Path, typer.Option("--out", "-o", metavar="OUT", help="Folder for the results.")]
WholeJson = Annotated[bool, typer.Option("--json", help="Print the whole result as JSON.")]
StrictOption = Annotated[bool, typer.Option("--strict", help="Exit with 1 if a pose is weak, too.")]
JobsOption = Annotated[
    int | None, typer.Option("--jobs", min=1, help="People: number of worker processes; all cores if left out.")
]


def available_cores() -> int:
    """The processors that this process may use."""
    # A container or a batch system may grant fewer than the machine has.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
