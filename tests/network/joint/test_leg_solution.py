"""The joint solution of a simulated laboratory whose scanners measure legs."""

import numpy as np
import pytest

from calgraph.config import Lidar2dSpec, People
from calgraph.config.settings import NetworkEstimationSettings, TrackingSettings
from calgraph.geometry import Array, se2
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.network.joint.estimate import NetworkSolution, solve_network
from calgraph.network.joint.legs import LegObservations
from calgraph.network.tracking.track import ScannerTracks
from calgraph.network.tracking.track_scanner import track_scanner
from calgraph.simulation import NetworkScenario, build_network, network_rig, network_truth, simulate_scans
from calgraph.simulation.network_scenario import PeopleOptions, ScannerOptions

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def solved() -> tuple[NetworkSolution, Array, Array]:
    """Solution, true poses and true clock offsets, from start poses that are 3 cm off."""
    scenario = NetworkScenario(
        layout="lab",
        duration=25.0,
        people=PeopleOptions(count=2, shape="legs"),
        scanner=ScannerOptions(count=5, rate=12.5, resolution=0.5, max_range=30.0, clock_offset=0.03),
    )
    network = build_network(scenario, 3)
    rig, truth = network_rig(network), network_truth(network)
    names = [scanner.name for scanner in network.scanners]
    tracked = []
    for scanner in network.scanners:
        spec = rig.sensors[scanner.name]
        assert isinstance(spec, Lidar2dSpec)
        found = track_scanner(simulate_scans(network, scanner), People(), spec.noise, settings=TrackingSettings())
        assert isinstance(found, ScannerTracks)
        tracked.append(found)
    in_plane = np.ix_((0, 1, 3), (0, 1, 3))
    true = np.stack([truth.T_root_sensor[name][in_plane] for name in names])
    rng = np.random.default_rng(0)
    error = rng.normal(0, [0.03, 0.03, 0.01], (len(names), 3))
    error[0] = 0
    start = PoseGraphSolution(se2.retract(true, error), np.zeros(0, dtype=np.bool_))
    nothing = PoseGraph(len(names), np.zeros((0, 2), dtype=np.intp), np.zeros((0, 3, 3)), np.zeros((0, 3, 3)))
    offsets = np.array([truth.clock_offsets[name] for name in names])
    return solve_network(People(), tracked, start, nothing, settings=NetworkEstimationSettings()), true, offsets


def test_poses_and_clocks_are_found(solved: tuple[NetworkSolution, Array, Array]) -> None:
    solution, true, offsets = solved
    error = se2.difference(solution.T_root_scanner, true)[1:]
    assert np.hypot(error[:, 0], error[:, 1]).mean() < 0.005
    assert np.degrees(np.abs(error[:, 2])).max() < 0.15
    assert np.abs(solution.clock_offset - offsets).max() < 1.5e-3


def test_bodies_are_legs_and_most_beams_are_used(solved: tuple[NetworkSolution, Array, Array]) -> None:
    network = solved[0].solved
    assert network is not None
    legs = network.network.bodies
    assert len(legs) >= 4
    assert all(isinstance(leg, LegObservations) for leg in legs)
    weight = np.concatenate([scans.weight for leg in legs for scans in leg.scans])
    assert np.mean(weight > 0) > 0.9
    radii = np.array([path.shape[0] for path in network.state.paths])
    assert np.median(radii) == pytest.approx(0.06, abs=0.008)
