"""Arguments and options that mean the same to several commands."""

import shlex
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import typer

from calgraph.errors import InputError

if TYPE_CHECKING:
    from calgraph.config.settings import DaskSettings
    from calgraph.parallel.engine import Engine

# Options in the panels of the help.
everyday = partial(typer.Option, rich_help_panel="Everyday")
earlier = partial(typer.Option, rich_help_panel="Prior poses, earlier results")
tuning = partial(typer.Option, rich_help_panel="Tuning")
RESULT_FILES = (
    "calibration.yaml",
    "report.html",
    "captures.csv",
    "budget.csv",
    "scene.npz",
    "residuals.csv",
    "rig.resolved.yaml",
)
"""What a calibration writes into its folder."""


def list_choices(literal: Any) -> str:
    """The choices of an option as its help shows them, with spaces at which lines can break."""
    return " | ".join(get_args(literal))


RigFile = Annotated[Path, typer.Argument(metavar="RIG.yaml", help="Sensors, target and captures.")]
# A path or a URL, of which Path would remove slashes.
OneRecording = Annotated[str, typer.Argument(metavar="RECORDING", help="Anything that calibrate reads.")]
Results = Annotated[Path, everyday("--out", "-o", metavar="OUT", help="Folder for the results.")]
ForceOption = Annotated[bool, everyday("--force", help="Replace the results in OUT, if there are any.")]
WholeJson = Annotated[bool, everyday("--json", help="Print the whole result as JSON.")]
StrictOption = Annotated[bool, everyday("--strict", help="Exit with 1 if a pose is weak, too.")]
SeedOption = Annotated[int, tuning(min=0, metavar="N", help="Seed of random samples: same seed, same result.")]
_MAX_JOBS = 256
"""Every process takes 100 MB or more; larger numbers are slips, and would stop the machine."""
JobsOption = Annotated[
    int | None,
    tuning("--jobs", min=1, max=_MAX_JOBS, metavar="N", help="Number of worker processes; all cores if left out."),
]

ClusterOption = Annotated[
    str | None,
    tuning(
        "--cluster",
        metavar="local | tcp://HOST:PORT",
        help="Let a cluster of Dask do the work: processes of this machine, or the address of its scheduler.",
    ),
]


NoCacheOption = Annotated[
    bool, tuning("--no-cache", help="Detect the target again, and keep nothing for later runs.")
]
EstimatorChoice = Literal["joint", "published"]


@contextmanager
def open_engine(jobs: int | None, cluster: str | None, settings: "DaskSettings") -> Iterator["Engine"]:
    """What evaluates the calls of a command, for the duration of the block.

    Args:
        jobs: number of processes of this machine; all its cores if None.
        cluster: where a cluster does it: see :func:`calgraph.parallel.open_cluster`.
        settings: of clusters.

    Raises:
        InputError: both are given, and the workers of the cluster are not processes of this machine; or as
            :func:`calgraph.parallel.open_cluster`.
        CalibrationError: as :func:`calgraph.parallel.open_cluster`.
    """
    from calgraph.parallel.engine import Processes
    from calgraph.parallel.open_cluster import LOCAL, open_cluster
    from calgraph.parallel.processes import available_cores

    if cluster is None:
        yield Processes(jobs or available_cores())
        return
    if jobs is not None and cluster != LOCAL:
        raise InputError(
            "--jobs: the number of workers of a cluster is its own; leave it out, or use --cluster local"
        )
    with open_cluster(cluster, jobs or available_cores(), settings) as engine:
        yield engine


def format_command() -> str:
    """The command line of this program, for provenance."""
    return shlex.join(["calgraph", *sys.argv[1:]])


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
