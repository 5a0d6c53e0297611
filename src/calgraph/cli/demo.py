"""``calgraph demo``: the whole story on a simulated robot."""

from pathlib import Path
from typing import Annotated

import typer

from calgraph.calibrate import Options, calibrate_rig
from calgraph.cli.calibrate import write_results
from calgraph.cli.progress import progress_bars
from calgraph.cli.tables import print_calibration
from calgraph.recording import open_recording
from calgraph.rig import load_rig
from calgraph.simulation import RigScenario, load_truth, simulate_rig


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", metavar="OUT", help="Folder for recording and results.")] = Path("demo"),
    seed: Annotated[int, typer.Option(help="Of the simulated robot and its noise.")] = 0,
) -> None:
    """Simulates a five-sensor robot, calibrates it from its recording, and compares with the truth."""
    with progress_bars() as progress:
        simulate_rig(RigScenario(), out, seed, progress=lambda done: progress("simulating", done))
        rig, truth = load_rig(out / "rig.yaml"), load_truth(out / "truth.yaml")
        with open_recording(out / "recording") as recording:
            calibration = calibrate_rig(rig, recording, Options(), progress)
    write_results(calibration, rig, out / "result")
    print_calibration(calibration, out / "result", truth.T_root_sensor)
