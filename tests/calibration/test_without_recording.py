"""Rigs and networks calibrated from arrays, without any file."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from calgraph.boards.detections import BoardCorners, Detection, PlanePatch
from calgraph.config import Lidar2dSpec, Lidar3dSpec, People, RangeNoise, Rig
from calgraph.errors import InputError, Rejected
from calgraph.geometry import Array, se3
from calgraph.network.checks.model_assessment import ModelAssessment
from calgraph.network.joint.estimate import NetworkSolution
from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import calibrate_network, calibrate_tracks
from calgraph.network.tracking.track import ScannerTracks, Track
from calgraph.recording import MessageRecording
from calgraph.result import Calibration
from calgraph.rig.bundle.problem_file import load_problem
from calgraph.rig.detection.from_measurements import (
    board_corners_from_pixels,
    plane_patch_from_points,
    segment_from_points,
)
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import calibrate_detections, solve_problem
from calgraph.sensors import LaserScan
from calgraph.simulation import NetworkScenario, simulate_network_scans
from detected_rigs import DetectedRig, detect_rig

SCANNERS = Rig(
    root="scanner_1",
    target=People(),
    sensors={f"scanner_{k}": Lidar2dSpec(topic=f"scanner_{k}", noise=RangeNoise(range=0.01)) for k in (1, 2, 3)},
)


def measured(one: DetectedRig) -> dict[str, dict[int, Detection | Rejected]]:
    """Detections from nothing but the arrays of what was measured."""
    cameras, sensors = one.captures.cameras, one.rig.sensors

    def again(name: str, detection: Detection) -> Detection | Rejected:
        if isinstance(detection, BoardCorners):
            return board_corners_from_pixels(detection.corners_board, detection.pixels, cameras[name])
        noise = sensors[name].noise
        assert isinstance(noise, RangeNoise)
        return (plane_patch_from_points if isinstance(detection, PlanePatch) else segment_from_points)(
            detection.points, noise
        )

    return {
        name: {capture: again(name, found[0]) for capture, found in by.items()}
        for name, by in one.captures.detections.items()
    }


def assert_close(found: Calibration, T_root_sensor: Mapping[str, Array], limit: float) -> None:
    for sensor in found.sensors:
        assert np.abs(se3.difference(sensor.T_root_sensor, T_root_sensor[sensor.name])).max() < limit


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("own") / "problem.npz"


@pytest.fixture(scope="module")
def calibration(kept: Path) -> Calibration:
    one = detect_rig()
    return calibrate_detections(one.rig, measured(one), RigOptions(folds=0, dump=kept), one.captures.cameras)


def test_rig_is_calibrated_from_arrays(calibration: Calibration) -> None:
    assert {sensor.name for sensor in calibration.sensors} == {"lidar", "camera", "laser_front"}
    # Standard deviations are up to 2.6 mm, in height of the 2-D scanner.
    assert_close(calibration, detect_rig().T_root_sensor, 0.008)


def test_problem_of_given_detections_is_kept(calibration: Calibration, kept: Path) -> None:
    again = solve_problem(load_problem(kept))
    poses = {sensor.name: sensor.T_root_sensor for sensor in calibration.sensors}
    assert all(np.array_equal(sensor.T_root_sensor, poses[sensor.name]) for sensor in again.sensors)


def test_people_are_no_board() -> None:
    with pytest.raises(InputError, match=r"target\.kind: must be board"):
        calibrate_detections(SCANNERS, {}, RigOptions())


@cache
def scans() -> tuple[dict[str, list[LaserScan]], Mapping[str, Array]]:
    # Range 30 m, so that three scanners of the L-shaped lab share enough in so little time.
    scenario = NetworkScenario.model_validate({"layout": "lab", "duration": 12.0, "scanner": {"count": 3}})
    sent, truth = simulate_network_scans(scenario, 1)
    return sent, truth.T_root_sensor


@cache
def calibrate_scans() -> Calibration:
    return calibrate_network(SCANNERS, MessageRecording(scans()[0]), NetworkOptions())


def test_network_is_calibrated_from_scans_at_hand() -> None:
    found = calibrate_scans()
    assert len(found.sensors) == 3
    assert_close(found, scans()[1], 0.03)


def test_the_error_budget_of_a_network_adds_up_to_its_covariance() -> None:
    found = calibrate_scans()
    assert found.budget is not None
    T = [found[name].T_root_sensor for name in ("scanner_2", "scanner_3")]
    relative = found.budget.relative_covariances(1, 2, *T)
    np.testing.assert_allclose(relative.sum(axis=0), found.covariance("scanner_2", "scanner_3"), rtol=1e-6)
    variances = np.sum(found.budget.stddev**2, axis=0)
    np.testing.assert_allclose(variances, [one.axis_stddev**2 for one in found.sensors], rtol=1e-9)


def test_averaged_poses_that_replace_others_contain_the_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    replaced = ModelAssessment(None, averaged_variance=9.0)
    monkeypatch.setattr("calgraph.network.pipeline.assess_network_model", lambda *_, **__: replaced)
    found = calibrate_network(SCANNERS, MessageRecording(scans()[0]), NetworkOptions())
    averaged = calibrate_network(SCANNERS, MessageRecording(scans()[0]), NetworkOptions(estimator="averaging"))
    np.testing.assert_allclose(found.joint_covariance, 9 * averaged.joint_covariance)


def test_what_tests_add_to_variances_is_no_error_of_what_is_extended(monkeypatch: pytest.MonkeyPatch) -> None:
    """The covariance with a kept scanner, which the same data halve at most."""
    two = SCANNERS.model_copy(update={"sensors": {k: v for k, v in SCANNERS.sensors.items() if k != "scanner_3"}})
    sent = MessageRecording({name: scans()[0][name] for name in two.sensors})
    measured = np.ix_([6, 7, 11], [12, 13, 17])

    def extend(factor: float) -> Array:
        def assess(joint: NetworkSolution, *_: object, **__: object) -> ModelAssessment:
            return ModelAssessment(joint.scale_covariance(factor, "scatter of parts"))

        monkeypatch.setattr("calgraph.network.pipeline.assess_network_model", assess)
        return calibrate_network(two, sent, NetworkOptions(extend=calibrate_scans())).joint_covariance

    earlier, plain, enlarged = calibrate_scans().joint_covariance, extend(1.0), extend(10.0)
    np.testing.assert_allclose(enlarged[measured], plain[measured], rtol=1e-6)
    np.testing.assert_allclose(enlarged[6:8, 6:8], 10 * plain[6:8, 6:8])
    assert 0.5 < np.linalg.norm(plain[measured]) / np.linalg.norm(earlier[measured]) < 1


def test_averaged_poses_have_no_error_budget(rng: np.random.Generator) -> None:
    own = walks({"scanner_1": np.eye(4), "scanner_2": np.eye(4)}, rng)
    assert calibrate_tracks(SCANNERS, own, NetworkOptions(estimator="averaging")).budget is None


def walks(T_root_scanner: Mapping[str, Array], rng: np.random.Generator) -> dict[str, ScannerTracks]:
    """Two people's positions by every scanner's own frame, each with noise of 2 cm, and no beams."""
    times = np.arange(0, 30, 0.1)
    paths = [
        np.column_stack([3 + 2 * np.cos(0.5 * times + a), b * np.sin(0.37 * times + b), 0 * times])
        for a, b in ((0.0, 2.0), (2.0, 3.0))
    ]

    def track(T: Array, path: Array) -> Track:
        own = se3.apply(se3.inverse(T), path)[:, :2] + rng.normal(0, 0.02, (len(times), 2))
        covariances = np.tile(0.02**2 * np.eye(2), (len(times), 1, 1))
        return Track(times, own, np.gradient(own, times, axis=0), covariances, period=0)

    return {
        name: ScannerTracks(tuple(track(T, path) for path in paths), np.zeros((0, 2)), 0.01)
        for name, T in T_root_scanner.items()
    }


def test_network_is_calibrated_from_given_tracks(rng: np.random.Generator) -> None:
    poses = {
        "scanner_1": np.eye(4),
        "scanner_2": se3.from_xyz_quaternion(np.array([6.0, 1, 0]), np.array([0, 0, 0.9, -0.4])),
        "scanner_3": se3.from_xyz_quaternion(np.array([3.0, -4, 0]), np.array([0, 0, 0.5, 0.8])),
    }
    found = calibrate_tracks(SCANNERS, walks(poses, rng), NetworkOptions(estimator="averaging"))
    assert len(found.sensors) == 3
    assert_close(found, poses, 0.02)


def test_scanner_without_tracks_is_unconnected_with_that_reason(rng: np.random.Generator) -> None:
    own = walks({"scanner_1": np.eye(4), "scanner_2": np.eye(4)}, rng)
    found = calibrate_tracks(SCANNERS, own, NetworkOptions(estimator="averaging"))
    assert "no tracks were given" in found.evidence.unconnected["scanner_3"]


def test_tracks_of_a_scanner_that_the_rig_lacks_are_an_error(rng: np.random.Generator) -> None:
    with pytest.raises(InputError, match="tracks: must be of scanner_1, scanner_2, scanner_3, got scanner_9"):
        calibrate_tracks(SCANNERS, walks({"scanner_9": np.eye(4)}, rng), NetworkOptions())


def test_tracks_are_of_scanners(rng: np.random.Generator) -> None:
    rig = replace_sensor(SCANNERS, Lidar3dSpec(topic="scanner_2"))
    with pytest.raises(InputError, match=r"sensors.scanner_2.kind: only 2-D scanners"):
        calibrate_tracks(rig, walks({"scanner_1": np.eye(4)}, rng), NetworkOptions())


def replace_sensor(rig: Rig, sensor: Lidar3dSpec) -> Rig:
    return rig.model_copy(update={"sensors": {**rig.sensors, sensor.topic: sensor}})
