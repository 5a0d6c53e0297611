"""``calgraph simulate rig``: a robot's recording with ground truth; every field of its scenario is an option."""

from typing import Any

from calgraph.cli.model_options import add_options, apply_options, list_options
from calgraph.cli.simulate_common import Out, ScenarioFile, Seed, simulate_to
from calgraph.io.yaml_reading import read_yaml, validate_content
from calgraph.simulation import RigScenario, simulate_rig

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
    simulate_to(out, simulate_rig, chosen, seed)


simulate_rig_command = add_options(simulate_rig_options, _MODEL_OPTIONS, RigScenario())
"""The command, its options read off :class:`RigScenario`."""
