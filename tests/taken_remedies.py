"""Networks whose scanners are weak, and calibrations after what their remedies ask for."""

from dataclasses import replace
from typing import Any

from calgraph.config import Board, Lidar2dUncertainty, Rig, SensorSpec, Tolerance
from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import calibrate_tracks
from calgraph.result import Calibration, Remedy
from calgraph.simulation import build_network, network_rig, simulate_scans
from calgraph.simulation.network_scanners import StationaryScanner
from lrf_network import track_scanners
from network_model_error_kinds import ROOMS, build_scenario

NETWORKS = {
    f"{room} {share:g}": (seconds, Tolerance(translation=tolerance, rotation=0.1))
    for share, seconds, tolerance in ((1 / 16, 60.0, 0.002), (0.25, 20.0, 0.005), (1.0, 20.0, 0.01))
    for room in ROOMS
}
"""By room and share of the systematic errors' priors that is drawn: duration, s, and tolerance."""


def solve_network(kind: str, seed: int, remedy: Remedy | None = None) -> Calibration:
    """The default calibration of a network, after a remedy."""
    (room, share), (seconds, tolerance) = kind.split(), NETWORKS[kind]
    duration = seconds + (remedy.duration if remedy else 0.0)
    network = build_network(build_scenario(room, "drawn", float(share), duration, "ellipse"), seed)
    rig = network_rig(network).model_copy(update={"tolerance": tolerance})
    if remedy:
        scanners = [correct_ranges(one, remedy, float(share)) for one in network.scanners]
        network, rig = replace(network, scanners=tuple(scanners)), state_uncertainty(rig, remedy)
    scans = {one.name: list(simulate_scans(network, one)) for one in network.scanners}
    return calibrate_tracks(rig, track_scanners(rig, scans, "nls"), NetworkOptions(seed=seed))


def correct_ranges(scanner: StationaryScanner, remedy: Remedy, share: float) -> StationaryScanner:
    """A scanner whose ranges are corrected by what a comparison found, which leaves errors of the stated size."""
    drawn, left = Lidar2dUncertainty(), remedy.uncertainty.get(scanner.name, {})
    errors = {key: getattr(scanner, key) * min(left[key] / (share * getattr(drawn, key)), 1.0) for key in left}
    return replace(scanner, **errors)


def state_uncertainty(rig: Rig, remedy: Remedy) -> Rig:
    """The rig with the uncertainties that a remedy leaves."""

    def known(part: SensorSpec | Board, of: str) -> SensorSpec | Board:
        uncertainty: Any = part.uncertainty.model_copy(update=dict(remedy.uncertainty.get(of, {})))
        return part.model_copy(update={"uncertainty": uncertainty})

    sensors: dict[str, Any] = {name: known(spec, name) for name, spec in rig.sensors.items()}
    target = rig.target if rig.is_network else known(rig.boards[0], "board")
    return rig.model_copy(update={"sensors": sensors, "target": target})
