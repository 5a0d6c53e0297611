"""``calgraph demo``: simulation and calibration of a robot."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from calgraph.calibration.result_files import make_provenance, write_results
from calgraph.cli.calibrate import fail_if_not_calibrated
from calgraph.cli.common_options import ForceOption, check_not_overwriting, format_command
from calgraph.cli.printing import print_calibration, print_errors, print_output_path
from calgraph.cli.progress import progress_bars
from calgraph.cli.simulate import simulate_into
from calgraph.config import load_rig
from calgraph.errors import InputError
from calgraph.io.atomic import replace_folder_atomically
from calgraph.parallel.engine import Processes
from calgraph.parallel.processes import available_cores
from calgraph.recording import open_recording, resolve_intrinsics
from calgraph.simulation import RigScenario, load_truth, simulate_rig


def demo(
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="OUT", help="Folder for recording and results.")
    ] = Path("demo"),
    force: ForceOption = False,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Seed of the simulated robot and its noise.")] = 0,
) -> None:
    """Simulate a five-sensor robot, calibrate it, and compare with the ground truth.

    Writes recording, rig.yaml, scenario.yaml, truth.yaml and result/ into OUT.
    """
    from calgraph.rig.options import RigOptions
    from calgraph.rig.pipeline import calibrate_rig

    if (out / "recording").exists() and not (out / "truth.yaml").exists():
        raise InputError(f"{out / 'recording'}: is not of a demo, it is not overwritten; choose another OUT")
    check_not_overwriting(out, ["recording", "rig.yaml", "result"], force=force)
    with replace_folder_atomically(out, "recording") as folder:
        with progress_bars() as progress:
            simulate_into(folder, simulate_rig, RigScenario(trigger=False), seed, progress)
            rig, truth = load_rig(folder / "rig.yaml"), load_truth(folder / "truth.yaml")
            with open_recording(folder / "recording") as recording:
                calibration = calibrate_rig(
                    rig, recording, RigOptions(engine=Processes(available_cores())), progress
                )
                read = ("rig", folder / "rig.yaml"), ("recording", folder / "recording")
                run = make_provenance(format_command(), read, recording)
                # The folder has a temporary name until it is complete.
                inputs = tuple(replace(one, path=str(out / Path(one.path).name)) for one in run.inputs)
                calibration = replace(calibration, provenance=replace(run, inputs=inputs))
                rig = resolve_intrinsics(rig, recording)
        (folder / "result").mkdir()
        write_results(calibration, rig, folder / "result", available_cores())
    print_calibration(calibration)
    print_errors(calibration, truth.T_root_sensor)
    print_output_path(out / "result")
    fail_if_not_calibrated(calibration)
