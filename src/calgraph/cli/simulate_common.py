"""What ``calgraph simulate rig`` and ``simulate network`` share: where to write, and writing it."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeVar

import typer
from pydantic import BaseModel

from calgraph.cli.console import console
from calgraph.cli.progress import progress_bars
from calgraph.errors import InputError
from calgraph.io.atomic import replace_folder_atomically
from calgraph.io.yaml_writing import save_yaml

Out = Annotated[
    Path,
    typer.Option("--out", "-o", metavar="OUT", help="Folder for recording, rig.yaml, ground truth and scenario."),
]
ScenarioFile = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Scenario from a file, as scenario.yaml in OUT; options take precedence."),
]
Seed = Annotated[int, typer.Option(metavar="N", min=0, help="The same seed and options give the same recording.")]

Scenario = TypeVar("Scenario", bound=BaseModel)
Simulate = Callable[[Scenario, Path, int, Callable[[int, int], None]], None]


def simulate_to(out: Path, simulate: Simulate[Scenario], scenario: Scenario, seed: int) -> None:
    """Writes recording, ground truth and scenario into the folder ``out``, all or none of them.

    Raises:
        InputError: there is a recording in ``out`` already.
    """
    if (out / "recording").exists():
        raise InputError(f"{out / 'recording'}: exists already; remove it or choose another OUT")
    with replace_folder_atomically(out, "recording") as folder, progress_bars() as progress:
        simulate_into(folder, simulate, scenario, seed, progress)
    console(stderr=True).print(
        f"Wrote {out}; next: calgraph calibrate {out / 'rig.yaml'} {out / 'recording'} -o {out / 'result'}",
        markup=False,
    )


def simulate_into(
    folder: Path,
    simulate: Simulate[Scenario],
    scenario: Scenario,
    seed: int,
    progress: Callable[[str, float], None],
) -> None:
    """Writes the recording, the ground truth, and their scenario into an existing folder."""
    simulate(scenario, folder, seed, lambda done, total: progress("simulating", done / total))
    save_yaml(folder / "scenario.yaml", scenario.model_dump(mode="json", exclude_none=True), f"seed: {seed}")
