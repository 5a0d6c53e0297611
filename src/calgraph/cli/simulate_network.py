"""``calgraph simulate network``: sensors and walking people with ground truth; every field is an option."""

from dataclasses import replace
from functools import partial
from itertools import cycle, islice
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from calgraph.cli.common_options import JobsOption
from calgraph.cli.model_options import add_options, apply_options, list_options
from calgraph.cli.simulate import Out, ScenarioFile, Seed, simulate_into, simulated_folder
from calgraph.errors import InputError
from calgraph.io.yaml_reading import read_yaml, validate_content
from calgraph.parallel.processes import available_cores
from calgraph.simulation import HallScenario, LayoutName, NetworkScenario, simulate_hall, simulate_network
from calgraph.simulation.hall_scenario import LidarModel
from calgraph.simulation.hall_simulation import record_hall

_PANELS = {
    "layout": "Building",
    "scanner": "2-D scanners",
    "people": "People",
    "errors": "Errors of scanners",
    "root": "Recording",
}
_MODEL_OPTIONS = {option.parameter: option for option in list_options(NetworkScenario, _PANELS)}
_HALL_OPTIONS = {"people_count": "people", "duration": "duration"}
"""Options of a network that a hall has, and its fields."""
Lidars = Annotated[
    int,
    typer.Option(
        "--lidars",
        metavar="N",
        min=0,
        max=100,
        help="3-D LiDARs in a hall, instead of 2-D scanners in a building; of the other options only "
        "--lidar-model, --scanners, --seed, --people-count and --duration are of halls.",
    ),
]
Scanners = Annotated[
    int,
    typer.Option(
        "--scanners",
        metavar="N",
        min=0,
        max=100,
        help="2-D scanners beside the LiDARs, 0.3, 0.9 and 1.4 m high in turn.",
    ),
]
_SCANNER_HEIGHTS = (0.3, 0.9, 1.4)
"""In turn, m: of shins, hips and shoulders."""
Model = Annotated[
    LidarModel, typer.Option("--lidar-model", help="16 or 32 rings, or a raster of 70 by 40 degrees.")
]


def simulate_network_options(
    out: Out,
    scenario: ScenarioFile = None,
    seed: Seed = 0,
    jobs: JobsOption = None,
    lidars: Lidars = 0,
    lidar_model: Model = "xt32",
    scanners: Scanners = 0,
    **options: Any,
) -> None:
    """Simulate scanners in a building, and people who walk through; write recording and ground truth.

    Defaults are those of the office; another layout has other defaults, which options override. With --lidars
    the sensors are 3-D LiDARs in a hall, and --scanners adds 2-D scanners.
    """
    if lidars:
        _refuse_options_of_scanners([*options, *(["scenario"] if scenario else [])])
        heights = tuple(islice(cycle(_SCANNER_HEIGHTS), scanners))
        hall = HallScenario(seed, lidars=(lidar_model,) * lidars, scanners=heights)
        _simulate_hall(out, hall, options)
        return
    if scanners:
        raise InputError("--scanners: are beside LiDARs (--lidars); --scanner-count is that of 2-D scanners alone")
    content = read_yaml(scenario) if scenario else {}
    if options.get("layout") in get_args(LayoutName):
        # Before the other options, so that options not given have the defaults of this layout.
        content = {**content, "layout": options["layout"]}
    start = validate_content(NetworkScenario, content, scenario or Path("options"))
    chosen = apply_options(start, _MODEL_OPTIONS, options)
    simulate = partial(simulate_network, jobs=jobs or available_cores())
    with simulated_folder(out) as (folder, progress):
        simulate_into(folder, simulate, chosen, seed, progress)


def _refuse_options_of_scanners(given: list[str]) -> None:
    unknown = [name for name in given if name not in _HALL_OPTIONS]
    if unknown:
        raise InputError(f"--{unknown[0].replace('_', '-')}: is of 2-D scanners; leave it out with --lidars")


def _simulate_hall(out: Path, start: HallScenario, options: dict[str, Any]) -> None:
    chosen = {
        _HALL_OPTIONS[name]: type(getattr(start, _HALL_OPTIONS[name]))(value) for name, value in options.items()
    }
    hall = replace(start, **chosen)
    with simulated_folder(out) as (folder, progress):
        record_hall(simulate_hall(hall), folder, lambda done, total: progress("writing", done / total))


simulate_network_command = add_options(simulate_network_options, _MODEL_OPTIONS, NetworkScenario())
"""The command, its options read off :class:`NetworkScenario`."""
