"""Arguments and options that mean the same to several commands."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from calgraph.errors import InputError

EVERYDAY, EARLIER, TUNING, PAPERS = (
    "Everyday",
    "Prior poses, earlier results",
    "Tuning",
    "Methods of the papers, for comparison",
)
"""Panels of the help of ``calibrate`` and ``solve``."""
RESULT_FILES = (
    "calibration.yaml",
    "report.html",
    "captures.csv",
    "scene.npz",
    "residuals.csv",
    "rig.resolved.yaml",
)
"""What a calibration writes into its folder."""


def list_choices(literal: Any) -> str:
    """The choices of an option as its help shows them, with spaces at which lines can break."""
    return " | ".join(get_args(literal))


RigFile = Annotated[Path, typer.Argument(metavar="RIG.yaml", help="Sensors, target and captures.")]
OneRecording = Annotated[Path, typer.Argument(metavar="RECORDING", help="Anything that calibrate reads.")]
Results = Annotated[
    Path, typer.Option("--out", "-o", metavar="OUT", help="Folder for the results.", rich_help_panel=EVERYDAY)
]
ForceOption = Annotated[
    bool, typer.Option("--force", help="Replace the results in OUT, if there are any.", rich_help_panel=EVERYDAY)
]
WholeJson = Annotated[
    bool, typer.Option("--json", help="Print the whole result as JSON.", rich_help_panel=EVERYDAY)
]
StrictOption = Annotated[
    bool, typer.Option("--strict", help="Exit with 1 if a pose is weak, too.", rich_help_panel=EVERYDAY)
]
SeedOption = Annotated[
    int,
    typer.Option(
        min=0, metavar="N", help="Seed of random samples: same seed, same result.", rich_help_panel=TUNING
    ),
]
_MAX_JOBS = 256
"""Every process takes 100 MB or more; larger numbers are slips, and would stop the machine."""
JobsOption = Annotated[
    int | None,
    typer.Option(
        "--jobs",
        min=1,
        max=_MAX_JOBS,
        metavar="N",
        help="Number of worker processes; all cores if left out.",
        rich_help_panel=TUNING,
    ),
]


def check_not_overwriting(folder: Path, names: Iterable[str], *, force: bool) -> None:
    """Checks, before long work begins, that no earlier result is in the way.

    Args:
        folder: for the results; other files in it stay.
        names: of what is written there.
        force: whether it may be replaced.

    Raises:
        InputError: one of them exists, and is not to be replaced.
    """
    found = [name for name in names if (folder / name).exists()]
    if found and not force:
        raise InputError(
            f"{folder}: contains earlier results ({', '.join(found)}); choose another OUT, or give --force to "
            f"replace them"
        )


def find_calibration(result: Path) -> Path:
    """The calibration.yaml in a folder of results, or the file given.

    Raises:
        InputError: the folder has none.
    """
    if not result.is_dir():
        return result
    file = result / "calibration.yaml"
    if not file.is_file():
        raise InputError(f"{result}: has no calibration.yaml; give the folder that calibrate wrote with -o")
    return file
