"""``calgraph simulate rig``: a robot's recording with ground truth; every field of its scenario is an option."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer
from pydantic import BaseModel

from calgraph.cli.console import console
from calgraph.cli.model_options import add_options, apply_options, list_options
from calgraph.cli.progress import progress_bars
from calgraph.errors import InputError
from calgraph.io.atomic import replace_folder_atomically
from calgraph.io.text_writing import save_yaml
from calgraph.io.yaml_reading import read_yaml, validate_content
from calgraph.simulation import RigScenario, simulate_rig

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


@contextmanager
def simulated_folder(out: Path) -> Iterator[tuple[Path, Callable[[str, float], None]]]:
    """A folder that becomes ``out``, whole or not at all, and what shows how much is written to it.

    Raises:
        InputError: there is a recording in ``out`` already.
    """
    if (out / "recording").exists():
        raise InputError(f"{out / 'recording'}: exists already; remove it or choose another OUT")
    with replace_folder_atomically(out, "recording") as folder, progress_bars() as progress:
        yield folder, progress
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


_PANELS = {
    "camera": "Cameras",
    "laser": "2-D scanners",
    "spinning": "3-D scanners made of a slowly spinning 2-D scanner",
    "multibeam": "Multi-beam LiDARs",
    "depth": "Depth cameras",
    "root": "Robot",
    "board": "Board",
    "bearings": "Poses of the board",
    "background": "Recording and disturbances",
}
_MODEL_OPTIONS = {
    option.parameter: option
    for option in list_options(RigScenario, _PANELS)
    # Priors of the calibration; a simulated board is exactly as stated.
    if option.path[:2] != ("board", "uncertainty")
}


def simulate_rig_options(out: Out, scenario: ScenarioFile = None, seed: Seed = 0, **options: Any) -> None:
    """Simulate a robot, a board, and an operator who carries it around; write recording and ground truth.

    Lists are given as numbers with commas between them, tags and patterns as in rig.yaml (YAML on one line).
    """
    start = validate_content(RigScenario, read_yaml(scenario), scenario) if scenario else RigScenario()
    if "board_pattern" in options:
        # A board has either tags or a pattern: a given pattern replaces the default tags.
        options.setdefault("board_tags", "[]")
    chosen = apply_options(start, _MODEL_OPTIONS, options)
    with simulated_folder(out) as (folder, progress):
        simulate_into(folder, simulate_rig, chosen, seed, progress)


simulate_rig_command = add_options(simulate_rig_options, _MODEL_OPTIONS, RigScenario())
"""The command, its options read off :class:`RigScenario`."""
