"""Kinds of simulated halls with 3-D LiDARs: ordinary ones, and those in which something is wrong or missing."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from calgraph.simulation import HallFaults, HallScenario
from drive_kinds import Draw, draw_size, make_faults

_SCANNER_HEIGHTS = (0.3, 0.9, 1.4, 0.9)
"""Of 2-D scanners beside LiDARs, m."""
RIGS: Mapping[str, Mapping[str, Any]] = {
    "16_rings": {"lidars": ("vlp16",) * 4},
    "32_rings": {"lidars": ("xt32",) * 4},
    "two": {"lidars": ("xt32",) * 2},
    "solid_state": {"lidars": ("xt32", "xt32", "solid_state", "solid_state")},
    "mixed": {"lidars": ("xt32",) * 2, "scanners": _SCANNER_HEIGHTS},
}
"""Sensors by name."""
_fault = partial(make_faults, HallFaults)
KINDS: Mapping[str, Draw] = {
    "ordinary": lambda _: {},
    "couples": lambda _: {"people": 4, "couples": 2},
    "high": lambda _: {"high": True},
    "moved": lambda rng: {"moved": int(rng.integers(3, 9))},
    "glass": lambda _: {"glass": 4},
    "mirrors": lambda _: {"mirrors": 2},
    "crowd": lambda rng: {"people": int(rng.integers(10, 15)), "couples": 3},
    "carts": lambda _: {"people": 0, "carts": 3},
    "one_person": lambda _: {"people": 1},
    "nobody": lambda _: {"people": 0},
    "sloping_floor": lambda _: {"floor_slope": 0.03},
    "stairs": lambda _: {"stairs": True},
    "rain": _fault(lambda rng: {"false_returns": draw_size(0.003, 0.1, rng)}),
    "bump": _fault(lambda rng: {"bump": (draw_size(0.005, 0.05, rng), draw_size(0.05, 2.0, rng))}),
    "swing": _fault(lambda rng: {"swing": draw_size(0.05, 1.0, rng)}),
    "rings": _fault(lambda _: {"ring_bias": 0.03}),
    "clock_drift": _fault(lambda rng: {"clock_drift": draw_size(2e-4, 3e-3, rng)}),
    "clock_jump": _fault(lambda rng: {"clock_jump": draw_size(0.01, 0.2, rng)}),
    "stretched": _fault(lambda rng: {"range_scale": float(rng.choice([-0.01, 0.01]))}),
}
"""Changes to the scenario by kind, drawn by seed."""
WRONG = tuple(kind for kind in KINDS if kind not in ("ordinary", "couples", "high"))
"""The kinds in which something is wrong or missing."""


def build_hall_scenario(kind: str, seed: int, rig: str = "32_rings", duration: float = 60.0) -> HallScenario:
    """The scenario of one run: two to four people, but for kinds that state their number.

    Args:
        kind: of :data:`KINDS`.
        seed: of the hall, and of what the kind draws.
        rig: of :data:`RIGS`.
        duration: s.
    """
    rng = np.random.default_rng((seed, 1000))
    scenario = HallScenario(seed=seed, duration=duration, people=2 + seed % 3, **RIGS[rig])
    return replace(scenario, **KINDS[kind](rng))
