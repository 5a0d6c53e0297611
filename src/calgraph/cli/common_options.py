"""Arguments and options that mean the same to several commands."""

from pathlib import Path
from typing import Annotated

import typer

RigFile = Annotated[Path, typer.Argument(metavar="RIG.yaml", help="Sensors, target and captures.")]
OneRecording = Annotated[Path, typer.Argument(metavar="RECORDING", help="Anything that calibrate reads.")]
Results = Annotated[Path, typer.Option("--out", "-o", metavar="OUT", help="Folder for the results.")]
WholeJson = Annotated[bool, typer.Option("--json", help="Print the whole result as JSON.")]
