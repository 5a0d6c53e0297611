"""Kinds of simulated drives: ordinary ones, and those that determine too little or in which something is wrong."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from calgraph.simulation import STANDARD_RIGS, DriveFaults, DriveScenario
from calgraph.simulation.drive_scenario import RigName

Draw = Callable[[np.random.Generator], dict[str, Any]]
"""Changes of a scenario."""


def draw_size(low: float, high: float, rng: np.random.Generator) -> float:
    """A size between two limits, each order of magnitude as likely."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def make_faults(kind: Callable[..., object], draw: Draw) -> Draw:
    """Faults of a kind, which occur somewhere between 30 and 70 % of the recording."""
    return lambda rng: {"faults": kind(time=float(rng.uniform(0.3, 0.7)), **draw(rng))}


_fault = partial(make_faults, DriveFaults)
KINDS: dict[str, Draw] = {
    "ordinary": lambda _: {},
    "planar": lambda _: {"path": "planar"},
    "clocks_half_a_second": lambda _: {"max_clock_offset": 0.5},
    "straight": lambda _: {"path": "straight"},
    "constant_turn": lambda _: {"path": "constant_turn", "world": "hall"},
    "turn_on_spot": lambda _: {"path": "turn_on_spot"},
    "corridor": lambda _: {"path": "straight", "world": "corridor", "people": 0},
    "corridor_both_ways": lambda _: {"world": "corridor", "people": 0},
    "field": lambda _: {"world": "field", "people": 0, "cars": 0},
    "truck": _fault(lambda _: {"truck": True}),
    "bump": _fault(lambda rng: {"bump": (draw_size(0.005, 0.05, rng), draw_size(0.05, 2.0, rng))}),
    "clock_drift": _fault(lambda rng: {"clock_drift": draw_size(2e-4, 3e-3, rng)}),
    "clock_jump": _fault(lambda rng: {"clock_jump": draw_size(0.01, 0.2, rng)}),
    "stretched": _fault(lambda rng: {"range_scale": float(rng.choice([-0.01, 0.01]))}),
}
"""Changes to the scenario by kind, drawn by seed; trucks need a yard or a hall."""
OUTDOORS = ("truck",)


def build_drive_scenario(
    kind: str, seed: int, rig: RigName = "two_lidars", duration: float = 60.0
) -> DriveScenario:
    """The scenario of one run.

    Args:
        kind: of :data:`KINDS`.
        seed: of the drive, and of what the kind draws.
        rig: of the standard rigs.
        duration: s.
    """
    rng = np.random.default_rng((seed, 1000))
    scenario = DriveScenario(seed=seed, duration=duration, sensors=STANDARD_RIGS[rig])
    if kind in OUTDOORS:
        scenario = replace(scenario, world=("yard", "hall")[seed % 2])
    return replace(scenario, **KINDS[kind](rng))
