"""Known truth: simulated recordings of robots with a board, to test and to benchmark calibrations on."""

from calgraph.simulation.ideal_detections import DetectionKnobs, simulate_detections
from calgraph.simulation.network_scenario import LayoutName, NetworkScenario, PeopleKnobs, ScannerKnobs
from calgraph.simulation.network_simulation import (
    Network,
    StationaryScanner,
    build_network,
    network_rig,
    network_truth,
    scans_of,
    simulate_network,
    simulate_network_scans,
)
from calgraph.simulation.rig_scenario import (
    BeamKnobs,
    CameraKnobs,
    LaserKnobs,
    MultibeamKnobs,
    RigScenario,
    SpinningKnobs,
)
from calgraph.simulation.rig_simulation import Progress, rig_of, simulate_rig
from calgraph.simulation.truth import BoardTruth, PersonTruth, Truth, load_truth, save_truth
from calgraph.simulation.world import (
    SimulatedCapture,
    Stage,
    set_stage,
    simulate_background,
    simulate_captures,
    truth_of,
)

__all__ = [
    "BeamKnobs", "BoardTruth", "CameraKnobs", "DetectionKnobs", "LaserKnobs", "LayoutName", "MultibeamKnobs",
    "Network", "NetworkScenario", "PeopleKnobs", "PersonTruth", "Progress", "RigScenario", "ScannerKnobs",
    "SimulatedCapture", "SpinningKnobs", "Stage", "StationaryScanner", "Truth", "build_network", "load_truth",
    "network_rig", "network_truth", "rig_of", "save_truth", "scans_of", "set_stage", "simulate_background",
    "simulate_captures", "simulate_detections", "simulate_network", "simulate_network_scans", "simulate_rig",
    "truth_of",
]  # fmt: skip
