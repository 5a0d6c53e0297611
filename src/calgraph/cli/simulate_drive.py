"""``calgraph simulate drive``: a robot that drives through surroundings, with ground truth."""

from dataclasses import asdict
from typing import Annotated

import typer

from calgraph.cli.simulate import Out, Seed, simulated_folder
from calgraph.io.text_writing import save_yaml
from calgraph.simulation.drive_motion import PathKind
from calgraph.simulation.drive_recording import record_drive
from calgraph.simulation.drive_scenario import STANDARD_RIGS, DriveScenario, RigName
from calgraph.simulation.drive_world import WorldKind

Rig = Annotated[RigName, typer.Option("--rig", help="Sensors of the robot.")]
DrivePath = Annotated[PathKind, typer.Option("--path", help="Kind of the path.")]
World = Annotated[
    WorldKind | None, typer.Option("--world", help="Surroundings; a room, a hall or a yard if left out.")
]
Duration = Annotated[float, typer.Option("--duration", metavar="S", min=2.0, max=3600.0, help="Duration, s.")]


def simulate_drive_command(
    out: Out,
    seed: Seed = 0,
    rig: Rig = "two_lidars",
    path: DrivePath = "ordinary",
    world: World = None,
    duration: Duration = 60.0,
) -> None:
    """Simulate a robot that drives; write recording, rig.yaml and ground truth."""
    scenario = DriveScenario(seed, duration, STANDARD_RIGS[rig], path, world)
    with simulated_folder(out) as (folder, progress):
        record_drive(scenario, folder, lambda done, total: progress("writing", done / total))
        save_yaml(folder / "scenario.yaml", asdict(scenario), f"seed: {seed}")
