"""Known truth: simulated recordings of robots with a board, to test and to benchmark calibrations on."""

from calgraph.simulation.rig import Progress, rig_of, simulate_rig
from calgraph.simulation.rig_scenario import (
    BeamKnobs,
    CameraKnobs,
    LaserKnobs,
    MultibeamKnobs,
    RigScenario,
    SpinningKnobs,
)
from calgraph.simulation.stage import (
    SimulatedCapture,
    Stage,
    set_stage,
    simulate_background,
    simulate_captures,
    truth_of,
)
from calgraph.simulation.truth import BoardTruth, Truth, load_truth, save_truth

__all__ = [
    "BeamKnobs", "BoardTruth", "CameraKnobs", "LaserKnobs", "MultibeamKnobs", "Progress", "RigScenario",
    "SimulatedCapture", "SpinningKnobs", "Stage", "Truth", "load_truth", "rig_of", "save_truth", "set_stage",
    "simulate_background", "simulate_captures", "simulate_rig", "truth_of",
]  # fmt: skip
