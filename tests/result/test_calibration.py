"""What a result says of itself."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from calgraph.geometry import Array, se2
from calgraph.result import (
    Calibration,
    Evidence,
    ModelledBodies,
    SensorPose,
    Suggestion,
    Verdict,
    join_covariances,
    load_calibration,
    save_calibration,
)
from calgraph.result.exports.json_text import to_json


def in_the_plane(count: int) -> Calibration:
    """Scanners on a floor, with what is uncertain there."""
    covariance = np.full((6, 6), np.nan)
    covariance[np.ix_([0, 1, 5], [0, 1, 5])] = np.diag([1e-4, 4e-4, 1e-6])
    number = np.arange(count, dtype=np.float64)
    poses = se2.to_se3(se2.pose(number * 1.1, np.stack([2 * number, -number], axis=-1)))
    sensors = (
        SensorPose(f"s{k}", "s0" if k else None, f"s{k}", "lidar2d", T, Verdict("good"))
        for k, T in enumerate(poses)
    )
    return Calibration(
        "s0", tuple(sensors), join_covariances([covariance if k else np.zeros((6, 6)) for k in range(count)])
    )


def with_last(calibration: Calibration, T: Array) -> Calibration:
    *others, last = calibration.sensors
    return dataclasses.replace(calibration, sensors=(*others, dataclasses.replace(last, T_root_sensor=T)))


def test_a_network_is_planar() -> None:
    assert in_the_plane(4).planar


def test_a_network_that_is_read_back_is_planar(tmp_path: Path) -> None:
    save_calibration(in_the_plane(4), tmp_path / "calibration.yaml")
    assert load_calibration(tmp_path / "calibration.yaml").planar


def test_files_state_what_a_network_does_not_measure_as_null(tmp_path: Path) -> None:
    network = in_the_plane(2)
    path = tmp_path / "calibration.yaml"
    save_calibration(network, path)
    written = YAML(typ="safe").load(path.read_text(encoding="utf-8"))
    shown = json.loads(to_json(network))
    last, root = network.sensors[-1].name, network.root
    for content in (written, shown):
        blank = [[value is None for value in row] for row in content["sensors"][last]["covariance"]]
        unmeasured = np.isin(np.arange(6), [2, 3, 4])
        np.testing.assert_array_equal(blank, unmeasured[:, None] | unmeasured)
        assert None not in np.ravel(content["sensors"][root]["covariance"])
        assert None in np.ravel(content["joint_covariance"]["matrix"])
    np.testing.assert_allclose(load_calibration(path).joint_covariance, network.joint_covariance)


def test_zeros_of_version_0_1_are_read_as_not_measured(tmp_path: Path) -> None:
    network, path = in_the_plane(3), tmp_path / "calibration.yaml"
    save_calibration(network, path)
    path.write_text(path.read_text(encoding="utf-8").replace("null", "0.0"), encoding="utf-8")
    read = load_calibration(path)
    assert read.planar
    for before, after in zip(network.sensors, read.sensors, strict=True):
        np.testing.assert_allclose(after.covariance, before.covariance)


def test_relative_poses_of_a_network_have_no_covariance_out_of_the_plane() -> None:
    network = in_the_plane(3)
    joint = np.array(network.joint_covariance).reshape(3, 6, 3, 6)
    joint[1, :, 2] = joint[2, :, 1] = np.where(np.isnan(joint[1, :, 1]), np.nan, 0.0)
    relative = dataclasses.replace(network, joint_covariance=joint.reshape(18, 18)).covariance("s1", "s2")
    unmeasured = np.isin(np.arange(6), [2, 3, 4])
    np.testing.assert_array_equal(np.isnan(relative), unmeasured[:, None] | unmeasured)
    # Both positions, and the yaw of s1 at a distance of the square root of 5.
    assert np.trace(relative[:2, :2]) == pytest.approx(2 * 5e-4 + 5 * 1e-6)
    assert relative[5, 5] == pytest.approx(2e-6)


def test_bodies_are_read_back(tmp_path: Path) -> None:
    evidence = Evidence(estimator="joint", bodies=ModelledBodies("legs", 24))
    save_calibration(dataclasses.replace(in_the_plane(2), evidence=evidence), tmp_path / "calibration.yaml")
    assert load_calibration(tmp_path / "calibration.yaml").evidence.bodies == evidence.bodies


def test_a_rig_is_not_planar(calibration: Calibration) -> None:
    assert not calibration.planar


def test_a_scanner_upside_down_is_in_the_plane() -> None:
    assert with_last(in_the_plane(3), np.diag([1.0, -1, -1, 1])).planar


def test_a_root_alone_has_no_plane() -> None:
    assert not in_the_plane(1).planar


def test_a_suggestion_states_large_deviations_without_exponents() -> None:
    step = Suggestion("hold it there", "laser", "height (z)", "m", 0.16, 0.032, np.eye(4))
    assert str(step) == "hold it there: σ of height (z) of laser 160 mm → 32 mm"
