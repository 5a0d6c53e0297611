"""Simulated recordings with ground truth: robots with a board, robots that drive, and networks with people."""

from calgraph.simulation.drive_scenario import STANDARD_RIGS, DriveFaults, DriveScenario, DriveSensor, RangeErrors
from calgraph.simulation.drive_simulation import DriveTruth, SimulatedDrive, simulate_drive
from calgraph.simulation.hall_scenario import HallFaults, HallScenario
from calgraph.simulation.hall_simulation import HallTruth, SimulatedHall, simulate_hall
from calgraph.simulation.network_scanners import StationaryScanner
from calgraph.simulation.network_scenario import (
    LayoutName,
    NetworkErrors,
    NetworkScenario,
    PeopleOptions,
    ScannerOptions,
)
from calgraph.simulation.network_simulation import (
    SimulatedNetwork,
    build_network,
    network_rig,
    network_truth,
    simulate_network,
    simulate_network_scans,
    simulate_scans,
)
from calgraph.simulation.rig_scenario import (
    BeamOptions,
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
)
from calgraph.simulation.rig_simulation import simulate_rig, world_rig
from calgraph.simulation.simulation_files import Progress
from calgraph.simulation.truth import BoardTruth, GroundTruth, PersonTruth, load_truth, save_truth
from calgraph.simulation.world import World, build_world, ground_truth

__all__ = [
    "STANDARD_RIGS", "BeamOptions", "BoardTruth", "CameraOptions", "DriveFaults", "DriveScenario", "DriveSensor",
    "DriveTruth", "GroundTruth", "HallFaults", "HallScenario", "HallTruth", "LaserOptions", "LayoutName",
    "MultibeamOptions", "NetworkErrors", "NetworkScenario", "PeopleOptions", "PersonTruth", "Progress",
    "RangeErrors", "RigScenario", "ScannerOptions", "SimulatedDrive", "SimulatedHall", "SimulatedNetwork",
    "SpinningOptions", "StationaryScanner", "World", "build_network", "build_world", "ground_truth",
    "load_truth", "network_rig", "network_truth", "save_truth", "simulate_drive", "simulate_hall",
    "simulate_network", "simulate_network_scans", "simulate_rig", "simulate_scans", "world_rig",
]  # fmt: skip
