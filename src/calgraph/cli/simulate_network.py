"""``calgraph simulate network``: scanners and walking people with ground truth; every field is an option."""

from functools import partial
from pathlib import Path
from typing import Any, get_args

from calgraph.cli.common_options import JobsOption
from calgraph.cli.model_options import add_options, apply_options, list_options
from calgraph.cli.simulate import Out, ScenarioFile, Seed, simulate_to
from calgraph.io.yaml_reading import read_yaml, validate_content
from calgraph.parallel.processes import available_cores
from calgraph.simulation import LayoutName, NetworkScenario, simulate_network

_PANELS = {
    "layout": "Building",
    "scanner": "2-D scanners",
    "people": "People",
    "errors": "Errors of scanners",
    "root": "Recording",
}
_MODEL_OPTIONS = {option.parameter: option for option in list_options(NetworkScenario, _PANELS)}


def simulate_network_options(
    out: Out, scenario: ScenarioFile = None, seed: Seed = 0, jobs: JobsOption = None, **options: Any
) -> None:
    """Simulate scanners in a building, and people who walk through; write recording and ground truth.

    Defaults are those of the office; another layout has other defaults, which options override.
    """
    content = read_yaml(scenario) if scenario else {}
    if options.get("layout") in get_args(LayoutName):
        # Before the other options, so that options not given have the defaults of this layout.
        content = {**content, "layout": options["layout"]}
    start = validate_content(NetworkScenario, content, scenario or Path("options"))
    chosen = apply_options(start, _MODEL_OPTIONS, options)
    simulate_to(out, partial(simulate_network, jobs=jobs or available_cores()), chosen, seed)


simulate_network_command = add_options(simulate_network_options, _MODEL_OPTIONS, NetworkScenario())
"""The command, its options read off :class:`NetworkScenario`."""
