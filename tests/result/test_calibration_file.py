"""calibration.yaml and captures.csv: what is written comes back, and damage is named."""

import csv
import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from calgraph.config import Tolerance
from calgraph.errors import InputError
from calgraph.geometry import Array, se3, so3
from calgraph.io.text_writing import save_yaml
from calgraph.io.yaml_reading import read_yaml
from calgraph.result import (
    Calibration,
    CaptureRow,
    FitError,
    SensorPose,
    Verdict,
    join_covariances,
    load_calibration,
    save_calibration,
)
from calgraph.result import save_captures as save_captures_csv

SMALL = 1e-6 * np.eye(6)


def root_and(sensor: SensorPose, covariance: Array = SMALL) -> Calibration:
    """A calibration of a root and one other sensor."""
    root = SensorPose("lidar", None, "velodyne", "lidar3d", np.eye(4), Verdict("good"))
    sensors = (root, dataclasses.replace(sensor, parent="lidar"))
    return Calibration("lidar", sensors, join_covariances([np.zeros((6, 6)), covariance]))


@pytest.fixture
def saved(calibration: Calibration, tmp_path: Path) -> Path:
    path = tmp_path / "calibration.yaml"
    save_calibration(calibration, path)
    return path


def damaged(saved: Path, old: str, new: str) -> Path:
    text = saved.read_text(encoding="utf-8")
    changed = re.sub(old, new, text, count=1, flags=re.DOTALL)
    assert changed != text
    saved.write_text(changed, encoding="utf-8")
    return saved


def test_poses_come_back_to_1e_12(calibration: Calibration, saved: Path) -> None:
    loaded = load_calibration(saved)
    for sensor in calibration.sensors:
        np.testing.assert_allclose(loaded[sensor.name].T_root_sensor, sensor.T_root_sensor, rtol=0, atol=1e-12)


def test_covariances_come_back_to_eight_digits(calibration: Calibration, saved: Path) -> None:
    loaded = load_calibration(saved)
    for sensor in calibration.sensors:
        np.testing.assert_allclose(loaded[sensor.name].covariance, sensor.covariance, rtol=1e-8)


def test_a_path_may_be_a_string(calibration: Calibration, tmp_path: Path) -> None:
    save_calibration(calibration, str(tmp_path / "calibration.yaml"))
    assert load_calibration(str(tmp_path / "calibration.yaml")).root == calibration.root


def test_names_verdicts_and_clocks_come_back(calibration: Calibration, saved: Path) -> None:
    def facts(c: Calibration) -> list[object]:
        return [(s.name, s.parent, s.kind, s.frame_id, s.verdict, s.clock_offset, s.clock_offset_stddev)
                for s in c.sensors]  # fmt: skip

    assert facts(load_calibration(saved)) == facts(calibration)


def test_edges_come_back_with_their_rms(calibration: Calibration, saved: Path) -> None:
    def facts(c: Calibration) -> list[object]:
        return [(e.sensor_a, e.sensor_b, e.captures, e.inliers, e.in_tree, e.note,
                 None if e.residual_rms is None else float(f"{e.residual_rms:.4g}"))
                for e in c.evidence.edges]  # fmt: skip

    assert facts(load_calibration(saved)) == facts(calibration)


def test_captures_come_back_without_their_residuals(calibration: Calibration, saved: Path) -> None:
    expected = {dataclasses.replace(row, residual=None) for row in calibration.evidence.captures}
    assert set(load_calibration(saved).evidence.captures) == expected


def test_root_estimator_unconnected_and_rms_come_back(calibration: Calibration, saved: Path) -> None:
    loaded = load_calibration(saved)
    assert (loaded.root, loaded.evidence.estimator, loaded.evidence.unconnected) == (
        "lidar",
        "bundle",
        calibration.evidence.unconnected,
    )
    assert loaded.evidence.residual_rms == pytest.approx(calibration.evidence.residual_rms, rel=1e-3)


def test_remarks_come_back(calibration: Calibration, tmp_path: Path) -> None:
    remarks = ("board edges in scans of lidar are 40 mm inside the target's size: they are not used",)
    save_calibration(
        dataclasses.replace(calibration, evidence=dataclasses.replace(calibration.evidence, remarks=remarks)),
        tmp_path / "calibration.yaml",
    )
    assert load_calibration(tmp_path / "calibration.yaml").evidence.remarks == remarks


def test_residuals_of_sensors_come_back(calibration: Calibration, tmp_path: Path) -> None:
    fit = {"camera": FitError(320, "px", 0.4125), "laser": FitError(900, "m", 0.0078)}
    evidence = dataclasses.replace(calibration.evidence, fit=fit)
    save_calibration(dataclasses.replace(calibration, evidence=evidence), tmp_path / "fit.yaml")
    assert load_calibration(tmp_path / "fit.yaml").evidence.fit == fit


def test_the_tolerance_of_verdicts_comes_back(calibration: Calibration, tmp_path: Path) -> None:
    tolerance = Tolerance(translation=0.02, rotation=0.5)
    evidence = dataclasses.replace(calibration.evidence, tolerance=tolerance)
    save_calibration(dataclasses.replace(calibration, evidence=evidence), tmp_path / "tolerant.yaml")
    assert load_calibration(tmp_path / "tolerant.yaml").evidence.tolerance == tolerance


def test_the_budget_comes_back_to_five_digits(budgeted: Calibration, tmp_path: Path) -> None:
    save_calibration(budgeted, tmp_path / "c.yaml")
    before, budget = budgeted.budget, load_calibration(tmp_path / "c.yaml").budget
    assert before is not None
    assert budget is not None
    assert (budget.sources, budget.covariance) == (before.sources, None)
    np.testing.assert_allclose(budget.stddev, before.stddev, rtol=5e-5, atol=1e-12)
    save_calibration(load_calibration(tmp_path / "c.yaml"), tmp_path / "again.yaml")
    assert (tmp_path / "again.yaml").read_bytes() == (tmp_path / "c.yaml").read_bytes()


def test_what_a_network_does_not_measure_is_null_in_its_budget(planar: Calibration, tmp_path: Path) -> None:
    save_calibration(planar, tmp_path / "c.yaml")
    stddev = read_yaml(tmp_path / "c.yaml")["budget"][0]["stddev"]["laser"]
    assert [value is None for value in stddev] == [False, False, True, True, True, False]
    budget = load_calibration(tmp_path / "c.yaml").budget
    assert budget is not None
    np.testing.assert_array_equal(budget.stddev[0, 3] > 0, [True, True, False, False, False, True])


def test_a_budget_of_other_sensors_is_refused(budgeted: Calibration, tmp_path: Path) -> None:
    save_calibration(budgeted, tmp_path / "c.yaml")
    changed = damaged(tmp_path / "c.yaml", r'("drift", stddev: \{)"camera"', r'\1"lidar"')
    with pytest.raises(
        InputError, match=r"budget\[2\]\.stddev: must be of all sensors but the root, camera, camera_2, "
    ):
        load_calibration(changed)


def test_writing_what_was_read_gives_the_same_file(saved: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.yaml"
    save_calibration(load_calibration(saved), again)
    assert again.read_text(encoding="utf-8") == saved.read_text(encoding="utf-8")


def test_the_file_has_the_keys_of_the_published_format(saved: Path) -> None:
    content = YAML(typ="safe").load(saved.read_text(encoding="utf-8"))
    assert list(content) == ["format", "root", "sensors", "quality"]
    assert set(content["sensors"]["camera"]) == {
        "parent", "kind", "frame_id", "translation", "rotation", "covariance", "clock_offset",
        "clock_offset_stddev",
    }  # fmt: skip
    assert "parent" not in content["sensors"]["lidar"]


def test_vectors_are_written_on_one_line(saved: Path) -> None:
    lines = saved.read_text(encoding="utf-8").splitlines()
    assert sum(bool(re.fullmatch(r"    (translation|rotation): \[.*\]", line)) for line in lines) == 8
    assert sum(line.startswith("    - [") and line.endswith("]") for line in lines) >= 24


def test_small_numbers_are_numbers_for_yaml_1_1_too(calibration: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "tiny.yaml"
    save_calibration(root_and(calibration["camera"], 1e-6 * np.eye(6)), path)
    text = path.read_text(encoding="utf-8")
    assert "1.0e-06" in text
    assert not re.search(r"[ \[]\d+e-", text)


@given(
    rotation=st.tuples(*[st.floats(-np.pi, np.pi)] * 3),
    translation=st.tuples(*[st.floats(-100, 100, allow_subnormal=False)] * 3),
)
@settings(max_examples=40, deadline=None)
def test_any_pose_comes_back(
    tmp_path_factory: pytest.TempPathFactory,
    rotation: tuple[float, float, float],
    translation: tuple[float, float, float],
) -> None:
    T = se3.pose(so3.exp(np.array(rotation)), np.array(translation))
    root = SensorPose("a", None, "a", "lidar3d", np.eye(4), Verdict("good"))
    other = SensorPose("b", "a", "b", "lidar2d", T, Verdict("good"))
    path = tmp_path_factory.mktemp("pose") / "c.yaml"
    save_calibration(Calibration("a", (root, other), join_covariances([np.zeros((6, 6)), np.eye(6)])), path)
    np.testing.assert_allclose(load_calibration(path)["b"].T_root_sensor, T, rtol=0, atol=1e-12)


def test_quaternions_are_written_with_w_not_negative(calibration: Calibration, tmp_path: Path) -> None:
    half_turn = se3.pose(so3.exp(np.array([0, 0, -3.5])), np.zeros(3))
    turned = dataclasses.replace(calibration["camera"], T_root_sensor=half_turn)
    path = tmp_path / "c.yaml"
    save_calibration(root_and(turned), path)
    assert YAML(typ="safe").load(path.read_text(encoding="utf-8"))["sensors"]["camera"]["rotation"][3] >= 0


def test_an_unobserved_direction_may_be_infinite(calibration: Calibration, tmp_path: Path) -> None:
    covariance = np.diag([1e-6, 1e-6, np.inf, 1e-8, 1e-8, 1e12])
    path = tmp_path / "c.yaml"
    save_calibration(root_and(calibration["laser"], covariance), path)
    np.testing.assert_array_equal(load_calibration(path)["laser"].covariance, covariance)


def test_names_may_hold_any_text(calibration: Calibration, tmp_path: Path) -> None:
    name = 'kamera: "vorn" # ümläut 前'
    odd = dataclasses.replace(calibration["camera"], name=name)
    path = tmp_path / "c.yaml"
    save_calibration(root_and(odd), path)
    assert load_calibration(path)[name].frame_id == "camera_optical"


def test_nothing_is_left_behind_but_the_file(saved: Path) -> None:
    assert [p.name for p in saved.parent.iterdir()] == ["calibration.yaml"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("calgraph/1", "calgraph/2", "format: must be calgraph/1, which this calgraph reads, got 'calgraph/2'"),
        ("format: calgraph/1\n", "", "format: must be calgraph/1, which this calgraph reads, got nothing"),
        ("root: lidar", "root: lidr",
         "root: must be one of the sensors, lidar, camera, camera_2, laser, got 'lidr'"),
        ("root: lidar\n", "", "root: is missing (The sensor whose frame the poses are in)"),
        ("    parent: lidar\n", "    parent: radar\n",
         "sensors.camera.parent: must be one of the sensors, lidar, camera, camera_2, laser, got 'radar'"),
        ("    parent: lidar\n", "    parent: camera_2\n",
         "sensors.camera.parent: the parents form a cycle that does not contain the root 'lidar'"),
        ("    parent: lidar\n", "    parents: lidar\n",
         "unknown key sensors.camera.parents; did you mean 'parent'?"),
        ("    rotation: [^\n]*\n    covariance", "    covariance",
         "sensors.lidar.rotation: is missing (Unit quaternion x, y, z, w)"),
        (r"(camera_optical\n.*?rotation: )\[.*?\]", r"\1[0.0, 0.0, 0.6, 0.6]",
         "sensors.camera.rotation: must be a quaternion x, y, z, w of length 1, its length is 0.8485"),
        (r"(camera_optical\n.*?rotation: )\[.*?\]", r"\1[0.0, 0.0, 0.6, 1e300]",
         "sensors.camera.rotation: must be a quaternion x, y, z, w of length 1, its length is 1e+300"),
        ("frame_id: camera_optical\n", f"frame_id: {'x' * 256}\n",
         "sensors.camera.frame_id: must have 255 characters or fewer, got 'xxx"),
        ("frame_id: camera_optical\n", 'frame_id: "\\\\e[31m"\n',
         "sensors.camera.frame_id: must have no control characters"),
        (r"suggestions: \[\]", "suggestions: [{hold: a, sensor: camera, axis: x, unit: m, stddev: 1.0, "
         "expected: 0.5, translation: [0.0, 0.0, 1.0], rotation: [0.0, 0.0, 0.6, 1e300]}]",
         "quality.suggestions[0].rotation: must be a quaternion x, y, z, w of length 1, its length is 1e+300"),
        ("camera_2", "x" * 256, f"sensors.'{'x' * 56}...: must have 255 characters or fewer, got 'xxx"),
        (r"(camera_optical\n.*?rotation: )\[.*?\]", r"\1[0.0, 0.0, 1.0]",
         "sensors.camera.rotation: must have 4 elements, got [0.0, 0.0, 1.0]"),
        (r"(camera_optical\n.*?translation: )\[.*?\]", r"\1[0.0, .nan, 1.0]",
         "sensors.camera.translation[1]: must be a finite number, got nan"),
        (r"(camera_optical\n.*?covariance:\n    - \[[^,]*, )[^,]*", r"\g<1>7.0",
         "sensors.camera.covariance[0][1]: must equal covariance[1][0], got 7 and "),
        (r"(camera_optical\n.*?covariance:\n    - \[)[^,]*", r"\1-7.0",
         "sensors.camera.covariance: must have variances of 0 or more on its diagonal and no NaN"),
        (r"(camera_optical\n.*?covariance:\n)    - \[[^\n]*\n", r"\1",
         "sensors.camera.covariance: must have 6 elements, got "),
        ("translation: .0.0, 0.0, 0.0.", "translation: [1.0, 0.0, 0.0]",
         "sensors.lidar: is the root, its translation must be 0 and its rotation none"),
        ("grade: good", "grade: fine",
         "quality.verdicts.lidar.grade: must be 'good', 'weak' or 'unobservable', got 'fine'"),
        ("quality:.*", "", "quality: is missing (The evidence for the poses)"),
        ("captures: 40", "captures: many", "quality.edges[0].captures: must be a whole number, got 'many'"),
        ("root: lidar", "root: lidar\nroot: lidar", "the key 'root' is given twice"),
    ],
)  # fmt: skip
def test_damage_is_named(saved: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(InputError) as raised:
        load_calibration(damaged(saved, old, new))
    assert str(raised.value).startswith(str(saved))
    assert message in str(raised.value)


def test_a_quaternion_typed_with_three_digits_is_normalised(saved: Path) -> None:
    path = damaged(saved, r"(camera_optical\n.*?rotation: )\[.*?\]", r"\1[0.0, 0.0, 0.383, 0.924]")
    R = load_calibration(path)["camera"].T_root_sensor[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.yaml: does not exist; check the path$"):
        load_calibration(tmp_path / "none.yaml")


def test_a_missing_folder_is_named(calibration: Calibration, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="its folder does not exist"):
        save_calibration(calibration, tmp_path / "none" / "calibration.yaml")


def test_captures_csv_has_a_row_for_each_capture_and_sensor(calibration: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "captures.csv"
    save_captures_csv(calibration, path)
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows[0] == {"capture": "0", "start": "1.500", "end": "4.000", "sensor": "lidar", "used": "yes",
                       "reason": "", "residual": "0.00400"}  # fmt: skip
    assert rows[1]["used"] == "no"
    assert rows[1]["reason"] == 'no tag found, "glare", maybe'
    assert rows[1]["residual"] == ""
    assert len(rows) == 4


def test_captures_csv_without_captures_has_its_header(tmp_path: Path, calibration: Calibration) -> None:
    path = tmp_path / "captures.csv"
    save_captures_csv(
        dataclasses.replace(calibration, evidence=dataclasses.replace(calibration.evidence, captures=())), path
    )
    assert path.read_text(encoding="utf-8").split() == ["capture,start,end,sensor,used,reason,residual"]


def test_a_reason_may_hold_line_breaks(tmp_path: Path, calibration: Calibration) -> None:
    row = CaptureRow(0, 0.0, 1.0, "lidar", False, "two\nlines")
    path = tmp_path / "captures.csv"
    save_captures_csv(
        dataclasses.replace(calibration, evidence=dataclasses.replace(calibration.evidence, captures=(row,))), path
    )
    with path.open(encoding="utf-8", newline="") as file:
        assert next(csv.DictReader(file))["reason"] == "two\nlines"


def test_covariances_with_a_negative_variance_are_refused(saved: Path) -> None:
    content = read_yaml(saved)
    name = next(one for one in content["sensors"] if one != content["root"])
    covariance = np.eye(6)
    covariance[0, 1] = covariance[1, 0] = 1.01
    content["sensors"][name]["covariance"] = covariance.tolist()
    save_yaml(saved, content)
    with pytest.raises(InputError, match=rf"sensors\.{name}\.covariance: must be positive semidefinite"):
        load_calibration(saved)


@pytest.mark.parametrize("key", ["0", "1", "2"])
def test_positions_off_the_earth_are_refused(saved: Path, key: str) -> None:
    content = read_yaml(saved)
    name = next(one for one in content["sensors"] if one != content["root"])
    content["sensors"][name]["translation"][int(key)] = 1e300
    save_yaml(saved, content)
    with pytest.raises(InputError, match=rf"translation\[{key}\]: must be 1e\+08 or less, got 1e\+300"):
        load_calibration(saved)
