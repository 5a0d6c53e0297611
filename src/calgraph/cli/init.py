"""``calgraph init``: a first rig.yaml from a recording."""

from pathlib import Path
from typing import Annotated

import typer

from calgraph.cli.common_options import OneRecording
from calgraph.cli.console import console
from calgraph.config import draft_rig
from calgraph.errors import InputError
from calgraph.io import write_text
from calgraph.recording import find_topics, open_recording


def init(
    recording: OneRecording,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="File to write.")] = Path("rig.yaml"),
    force: Annotated[bool, typer.Option("--force", help="Overwrite FILE if it exists.")] = False,
) -> None:
    """Draft a rig.yaml from the topics of a recording, with comments that say what to check and to measure."""
    if out.exists() and not force:
        raise InputError(f"{out}: exists already; choose another FILE, or give --force to overwrite it")
    with open_recording(recording) as opened:
        text = draft_rig(find_topics(opened), str(recording))
    write_text(out, text)
    console(stderr=True).print(f"Wrote {out}: state your board in it, and go through its comments", markup=False)
