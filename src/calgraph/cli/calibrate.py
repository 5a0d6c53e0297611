"""``calgraph calibrate``: from a rig.yaml and recordings to a folder of results."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from calgraph.calibrate import Options, calibrate_rig
from calgraph.cli.progress import progress_bars
from calgraph.cli.tables import print_calibration
from calgraph.recording import open_recordings
from calgraph.report import write_report
from calgraph.result import Calibration, save_calibration, save_captures, to_json
from calgraph.rig import Rig, load_rig, replacing_folder, save_yaml


class FilterChoice(StrEnum):
    """Values of --filter."""

    ransac = "ransac"
    none = "none"


class StartChoice(StrEnum):
    """Values of --start."""

    tree = "tree"
    identity = "identity"


def calibrate(
    rig_file: Annotated[Path, typer.Argument(metavar="RIG.yaml", help="Sensors, target and captures.")],
    recordings: Annotated[
        list[Path],
        typer.Argument(metavar="RECORDING...", help="rosbag2 folder, .mcap, .db3, ROS 1 .bag, or plain folder."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="OUT", help="Folder for the results.")],
    keep: Annotated[
        FilterChoice, typer.Option("--filter", help="Use the matches that agree, or all (the paper compares).")
    ] = FilterChoice.ransac,
    start: Annotated[
        StartChoice, typer.Option("--start", help="Start of the joint solution (the paper compares).")
    ] = StartChoice.tree,
    seed: Annotated[int, typer.Option(help="Of the random samples: same seed, same result.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Finds the relative poses of all sensors of a rig.

    Writes calibration.yaml, report.html, captures.csv and rig.resolved.yaml into OUT. Exit code 0: calibrated;
    1: a sensor could not be (the others are written all the same); 2: bad input.
    """
    rig = load_rig(rig_file)
    options = Options(keep=keep.value, start=start.value, seed=seed)
    with open_recordings(recordings) as recording, progress_bars() as progress:
        calibration = calibrate_rig(rig, recording, options, progress)
    write_results(calibration, rig, out)
    if json:
        typer.echo(to_json(calibration))
    else:
        print_calibration(calibration, out)
    for name, reason in calibration.unconnected.items():
        typer.echo(f"calgraph: {name} is not calibrated: {reason}", err=True)
    if calibration.unconnected:
        raise typer.Exit(1)


def write_results(calibration: Calibration, rig: Rig, out: Path) -> None:
    """Writes the files of a calibration into the folder ``out``, all or none of them."""
    with replacing_folder(out) as folder:
        save_calibration(calibration, folder / "calibration.yaml")
        save_captures(calibration, folder / "captures.csv")
        save_yaml(folder / "rig.resolved.yaml", rig.settings())
        write_report(calibration, rig, folder / "report.html")
