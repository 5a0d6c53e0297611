"""Options for prior poses and rigid groups, which ``calibrate`` and ``solve`` share."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from calgraph.cli.common_options import earlier
from calgraph.errors import InputError

if TYPE_CHECKING:
    from calgraph.result.extrinsics_file import PriorFile
    from calgraph.rig.bundle.priors import RigidFile

PriorOption = Annotated[
    Path | None,
    earlier(
        "--prior",
        metavar="FILE",
        help="Prior poses (board, drive): calibration.yaml, URDF, or transforms of tf (YAML).",
    ),
]
DeviationOption = Annotated[
    tuple[float, float] | None,
    earlier(
        "--prior-stddev",
        metavar="M DEG",
        help="Standard deviations of prior poses, m and degrees; 0 0: exact. A calibration.yaml contains them.",
    ),
]
RigidOption = Annotated[
    list[str] | None,
    earlier(
        "--rigid",
        metavar="FILE:A,B,...",
        help="Board: sensors A, B, ... are fixed to each other with the poses in FILE; repeatable.",
    ),
]


def read_priors(
    prior: Path | None, stddev: tuple[float, float] | None, rigid: list[str] | None
) -> tuple[PriorFile | None, tuple[RigidFile, ...]]:
    """What the options ask for, the files read.

    Raises:
        InputError: an option, or a file, is wrong.
    """
    if stddev is not None and prior is None:
        raise InputError("--prior-stddev: goes with --prior")
    if stddev is not None and not (stddev == (0, 0) or (min(stddev) > 0 and all(map(math.isfinite, stddev)))):
        raise InputError(
            f"--prior-stddev: must be two numbers above 0, in m and degrees, or 0 0 for poses that are exact, "
            f"got {stddev[0]:g} {stddev[1]:g}"
        )
    if not (prior or rigid):
        return None, ()
    # Modules that few calls need.
    from calgraph.result import read_extrinsics
    from calgraph.result.extrinsics_file import PriorFile
    from calgraph.rig.bundle.priors import RigidFile

    groups = []
    for text in rigid or ():
        file, _, names = text.rpartition(":")
        if not file or not names:
            raise InputError(f"--rigid: must be a file and sensors, as in robot.urdf:camera,laser, got {text!r}")
        groups.append(RigidFile(read_extrinsics(Path(file)), tuple(names.split(","))))
    deviations = (stddev[0], math.radians(stddev[1])) if stddev else None
    return PriorFile(read_extrinsics(prior), deviations) if prior else None, tuple(groups)


def list_prior_files(prior: Path | None, rigid: list[str] | None) -> list[tuple[str, Path | str]]:
    """The files that the options name, with their kinds, as a result states what it was computed from."""
    groups: list[tuple[str, Path | str]] = [("rigid group", text.rpartition(":")[0]) for text in rigid or ()]
    return [("prior", prior), *groups] if prior else groups
