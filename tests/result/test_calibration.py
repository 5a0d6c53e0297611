"""What a result says of itself."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from calgraph.geometry import Array, se2
from calgraph.result import Calibration, SensorPose, Verdict, join_covariances, load_calibration, save_calibration
from calgraph.result.exports.json_text import to_json


def in_the_plane(count: int) -> Calibration:
    """Scanners on a floor, with what is uncertain there."""
    covariance = np.zeros((6, 6))
    covariance[np.ix_([0, 1, 5], [0, 1, 5])] = np.diag([1e-4, 4e-4, 1e-6])
    number = np.arange(count, dtype=np.float64)
    poses = se2.to_se3(se2.pose(number * 1.1, np.stack([2 * number, -number], axis=-1)))
    sensors = (
        SensorPose(f"s{k}", "s0" if k else None, f"s{k}", "lidar2d", T, Verdict("good"))
        for k, T in enumerate(poses)
    )
    return Calibration("s0", tuple(sensors), join_covariances([covariance * (k > 0) for k in range(count)]))


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


def test_a_rig_is_not_planar(calibration: Calibration) -> None:
    assert not calibration.planar


@pytest.mark.parametrize("lifted", [(2, 3, 0.1), (0, 2, 0.01)], ids=["higher", "tilted"])
def test_a_sensor_out_of_the_plane_makes_it_no_plane(lifted: tuple[int, int, float]) -> None:
    network = in_the_plane(3)
    T = network.sensors[-1].T_root_sensor.copy()
    row, column, by = lifted
    T[row, column] = by
    T[2, :3] = np.cross(T[0, :3], T[1, :3])
    assert not with_last(network, T).planar


def test_a_scanner_upside_down_is_in_the_plane() -> None:
    assert with_last(in_the_plane(3), np.diag([1.0, -1, -1, 1])).planar


def test_a_root_alone_has_no_plane() -> None:
    assert not in_the_plane(1).planar
