"""A scanner that moved, found from tracks: everything is solved again from its later tracks."""

import numpy as np
import pytest

from calgraph.calibration.dispatch import calibrate
from calgraph.geometry import se3
from calgraph.network.options import NetworkOptions
from calgraph.recording import MessageRecording
from calgraph.result import Calibration
from calgraph.simulation import (
    GroundTruth,
    NetworkScenario,
    build_network,
    network_rig,
    network_truth,
    simulate_scans,
)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def halls() -> tuple[Calibration, GroundTruth]:
    """Halls in which no background is sufficient for the test, and scanner_2 is turned by 3° after 30 s."""
    scenario = NetworkScenario.model_validate({"layout": "halls", "errors": {"bump_turn": 3.0}})
    network = build_network(scenario, 1)
    rig = network_rig(network)
    scans = {rig.topics[one.name]: list(simulate_scans(network, one)) for one in network.scanners}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("calgraph.network.tracking.stationarity._MIN_POINTS", 10_000)
        found = calibrate(rig, MessageRecording(scans), NetworkOptions(estimator="averaging"))
    return found, network_truth(network)


def test_the_bump_is_named(halls: tuple[Calibration, GroundTruth]) -> None:
    (remark,) = [text for text in halls[0].evidence.remarks if " moved by " in text]
    assert remark.startswith("scanner_2 ")
    assert "the result is its pose after that" in remark


def test_the_result_is_the_pose_after_the_bump(halls: tuple[Calibration, GroundTruth]) -> None:
    found, truth = halls
    error = se3.difference(found["scanner_2"].T_root_sensor, truth.T_root_sensor["scanner_2"])
    assert np.degrees(abs(error[5])) < 0.5
