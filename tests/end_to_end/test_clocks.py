"""Rigs and networks whose clocks have nothing in common."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from calgraph.calibration.dispatch import calibrate as calibrate_any
from calgraph.config import Rig, load_rig
from calgraph.network.options import NetworkOptions
from calgraph.recording import open_recording
from calgraph.recording.takes import shift_record
from calgraph.simulation import (
    CameraOptions,
    GroundTruth,
    LaserOptions,
    MultibeamOptions,
    NetworkScenario,
    RigScenario,
    SpinningOptions,
    simulate_network,
)
from simulated_rigs import (
    SimulatedRecording,
    build_recording,
    calibrate,
    keep_decoded,
    pose_errors,
    simulate_scenario,
)

pytestmark = pytest.mark.slow

SCENARIO = RigScenario(
    camera=CameraOptions(width=640, height=480, texels_per_mm=1.0),
    laser=LaserOptions(count=1),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=1, rings=16),
    bearings=(-35, -20, -8, 8, 20, 35),
    samples=1,
)
CAMERA, SCANNER, LIDAR, TRIGGER = "/camera/image_raw/compressed", "/laser_front/scan", "/lidar/points", "/trigger"
Recorded = tuple[Rig, SimulatedRecording, GroundTruth]


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    rig, recording, truth = simulate_scenario(SCENARIO, 3)
    return rig, keep_decoded(recording), truth


def shift(recorded: Recorded, offsets: Mapping[str, float], *, arrivals: bool = False) -> SimulatedRecording:
    """The recording with stamps of topics, and arrivals if told so, ahead by offsets, s."""
    return build_recording(
        shift_record(record, offset := offsets.get(record.topic, 0.0), offset if arrivals else 0.0)
        for record in recorded[1].messages
    )


def with_offsets(rig: Rig, **stated: float | str) -> Rig:
    sensors = {
        name: spec.model_copy(update={"clock_offset": stated.get(name)}) for name, spec in rig.sensors.items()
    }
    return rig.model_copy(update={"sensors": sensors})


def check_poses(recorded: Recorded, rig: Rig, recording: SimulatedRecording) -> None:
    """All sensors have poses as good as with one clock."""
    errors = pose_errors(calibrate(rig, recording), recorded[2])
    assert len(errors) == 2
    for error in errors.values():
        assert np.linalg.norm(error[:3]) < 0.012
        assert np.degrees(np.linalg.norm(error[3:])) < 0.4


@pytest.mark.parametrize(
    "offsets",
    [
        {TRIGGER: -1_699_990_000.0, SCANNER: 37.0},
        {CAMERA: -1_699_990_000.0, LIDAR: -1_699_123_456.0, SCANNER: -1_698_765_432.0},
        {CAMERA: 0.5},
    ],
)
def test_clocks_that_differ_by_their_arrivals_cost_nothing(
    recorded: Recorded, offsets: Mapping[str, float]
) -> None:
    check_poses(recorded, recorded[0], shift(recorded, offsets))


@pytest.mark.parametrize("offsets", [{CAMERA: 0.8}, {SCANNER: 0.5}, {LIDAR: 0.5}])
def test_a_sensor_that_is_late_after_each_trigger_is_found(
    recorded: Recorded, offsets: Mapping[str, float]
) -> None:
    """Neither stamps nor arrivals show it, and its views after a trigger are of the move before."""
    check_poses(recorded, recorded[0], shift(recorded, offsets, arrivals=True))


@pytest.mark.parametrize(
    "stated", [{"lidar": "estimate"}, {"camera": 1_699_990_000.0, "laser_front": 1_699_990_000.0}]
)
def test_what_may_be_stated_of_clocks_works(recorded: Recorded, stated: Mapping[str, float | str]) -> None:
    """The LiDAR, which counts from power-up, is the root; its clock may be estimated, too."""
    assert recorded[0].root == "lidar"
    check_poses(recorded, with_offsets(recorded[0], **stated), shift(recorded, {LIDAR: -1_699_990_000.0}))


def test_a_network_with_a_scanner_in_atomic_time_is_that_without(tmp_path: Path) -> None:
    simulate_network(NetworkScenario(layout="office", duration=40), tmp_path / "network", seed=1)
    rig = load_rig(tmp_path / "network/rig.yaml")
    late = next(name for name in rig.sensors if name != rig.root)
    with open_recording(tmp_path / "network/recording") as recording:
        records = list(recording.records())
        changed = build_recording(
            shift_record(r, 37.0, 0.0) if r.topic == rig.topics[late] else r for r in records
        )
        before, after = (calibrate_any(rig, one, NetworkOptions()) for one in (build_recording(records), changed))
    for name in rig.sensors:
        difference = np.linalg.norm(before[name].T_root_sensor[:3, 3] - after[name].T_root_sensor[:3, 3])
        assert difference < 1e-3
    assert after[late].clock_offset == pytest.approx(37.0, abs=0.05)
    assert any("leap seconds" in remark for remark in after.evidence.remarks)
