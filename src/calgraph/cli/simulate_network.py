"""``calgraph simulate network``: stationary scanners and walking people with known truth, a knob an option."""

from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from calgraph.cli.console import console
from calgraph.cli.knobs import knobs_of, settings, with_knobs
from calgraph.cli.progress import progress_bars
from calgraph.errors import InputError
from calgraph.rig import replacing_folder, save_yaml
from calgraph.rig.reading import read_yaml, validated
from calgraph.simulation import LayoutName, NetworkScenario, simulate_network

_PANELS = {
    "layout": "Building",
    "scanner": "2-D scanners",
    "people": "People",
    "root": "Recording",
}
_KNOBS = {knob.parameter: knob for knob in knobs_of(NetworkScenario, _PANELS)}


def simulate_network_options(
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
    """Simulate 2-D scanners fixed in a building, and people who walk through it; write recording and truth.

    Defaults are those of the office; another layout brings its own, which options override.
    """
    content = read_yaml(scenario) if scenario else {}
    if options.get("layout") in get_args(LayoutName):
        # Before the other options, so that knobs that nobody turns are as this layout has them.
        content = {**content, "layout": options["layout"]}
    start = validated(NetworkScenario, content, scenario or Path("options"))
    chosen = settings(start, _KNOBS, options)
    if (out / "recording").exists():
        raise InputError(f"{out / 'recording'}: exists already; remove it or choose another OUT")
    with replacing_folder(out) as folder, progress_bars() as progress:
        simulate_network(chosen, folder, seed, lambda done, total: progress("simulating", done / total))
        save_yaml(
            folder / "scenario.yaml", chosen.model_dump(mode="json", exclude_none=True), comment=f"seed: {seed}"
        )
    console(stderr=True).print(
        f"Wrote {out}; next: calgraph calibrate {out / 'rig.yaml'} {out / 'recording'} -o {out / 'result'}",
        markup=False,
    )


simulate_network_command = with_knobs(simulate_network_options, _KNOBS, NetworkScenario())
"""The command, its options read off :class:`NetworkScenario`."""
