"""``calgraph simulate rig``: a robot's recording with known truth; every knob of its scenario is an option."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from calgraph.cli.console import console
from calgraph.cli.knobs import knobs_of, settings, with_knobs
from calgraph.cli.progress import progress_bars
from calgraph.errors import InputError
from calgraph.rig import replacing_folder, save_yaml
from calgraph.rig.reading import read_yaml, validated
from calgraph.simulation import RigScenario, simulate_rig

_PANELS = {
    "camera": "Cameras",
    "laser": "2-D scanners",
    "spinning": "3-D scanners made of a slowly spinning 2-D scanner",
    "multibeam": "Multi-beam LiDARs",
    "root": "Robot",
    "board": "Board",
    "bearings": "Poses of the board",
    "background": "Recording and disturbances",
}
_KNOBS = {knob.parameter: knob for knob in knobs_of(RigScenario, _PANELS)}


def simulate_rig_options(
    out: Annotated[
        Path,
        typer.Option("--out", "-o", metavar="OUT", help="Folder for recording, rig.yaml, truth and scenario."),
    ],
    scenario: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Knobs from a file, as scenario.yaml in OUT; options go first."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="The same seed and knobs give the same recording.")] = 0,
    **options: Any,
) -> None:
    """Simulate a robot, a board, and an operator who carries it around; write the recording and the truth.

    Lists are given as numbers with commas between them, tags and patterns as in rig.yaml (YAML on one line).
    """
    start = validated(RigScenario, read_yaml(scenario), scenario) if scenario else RigScenario()
    if "board_pattern" in options:
        # A board has either; whoever asks for a pattern does not mean the default tags.
        options.setdefault("board_tags", "[]")
    chosen = settings(start, _KNOBS, options)
    if (out / "recording").exists():
        raise InputError(f"{out / 'recording'}: exists already; remove it or choose another OUT")
    with replacing_folder(out) as folder, progress_bars() as progress:
        simulate_into(folder, chosen, seed, progress)
    console(stderr=True).print(
        f"Wrote {out}; next: calgraph calibrate {out / 'rig.yaml'} {out / 'recording'} -o {out / 'result'}",
        markup=False,
    )


simulate_rig_command = with_knobs(simulate_rig_options, _KNOBS, RigScenario())
"""The command, its options read off :class:`RigScenario`."""


def simulate_into(folder: Path, scenario: RigScenario, seed: int, progress: Callable[[str, float], None]) -> None:
    """Writes the recording, the truth, and the scenario they come from into an existing folder."""
    simulate_rig(scenario, folder, seed, progress=lambda done, total: progress("simulating", done / total))
    save_yaml(folder / "scenario.yaml", scenario.model_dump(mode="json", exclude_none=True), f"seed: {seed}")
