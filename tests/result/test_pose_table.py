"""A calibration as consoles and notebooks show it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import calgraph
from calgraph.geometry import se3, so3
from calgraph.result import Calibration, Evidence, SensorPose, Verdict, save_calibration


@pytest.fixture
def calibration() -> Calibration:
    T = se3.pose(so3.exp(np.array([0.0, 0.0, np.pi / 2])), np.array([0.1234, -2.0, 0.0]))
    sensors = (
        SensorPose("lidar", None, "lidar", "lidar3d", np.eye(4), Verdict("good")),
        SensorPose("<b>", "lidar", "laser", "lidar2d", T, Verdict("weak", "x is loose")),
    )
    joint = np.zeros((12, 12))
    joint[6:, 6:] = np.diag([0.012**2, 1e-6, 1e-6, np.radians(0.3) ** 2, 1e-8, 1e-8])
    return Calibration("lidar", sensors, joint, evidence=Evidence(unconnected={"sonar": "has no messages"}))


def test_a_calibration_prints_as_a_table(calibration: Calibration) -> None:
    head, root, laser, sonar = repr(calibration).splitlines()
    assert head.split("  ")[0] == "sensor"
    assert root.split()[-1] == "root"
    assert laser.split() == ["<b>", "0.1234", "-2.0000", "0.0000", "0.000", "0.000", "90.000", "12", "0.3", "weak"]
    assert sonar.split(maxsplit=1) == ["sonar", "not calibrated"]
    assert len({len(line) for line in (head, laser, sonar)}) == 1


def test_a_notebook_shows_the_same_table(calibration: Calibration) -> None:
    html = calibration._repr_html_()
    assert html.count("<tr>") == 4
    assert "<td>&lt;b&gt;</td><td>0.1234</td>" in html


def test_a_calibration_is_read_from_its_folder(calibration: Calibration, tmp_path: Path) -> None:
    laser = dataclasses.replace(calibration.sensors[1], name="laser")
    named = dataclasses.replace(calibration, sensors=(calibration.sensors[0], laser))
    save_calibration(named, tmp_path / "calibration.yaml")
    assert calgraph.load_calibration(str(tmp_path))["laser"].verdict.grade == "weak"
    with pytest.raises(calgraph.InputError, match="has no calibration"):
        calgraph.load_calibration(tmp_path.parent / tmp_path.name / "..")


def test_options_are_those_of_the_target_if_left_out(tmp_path: Path) -> None:
    """Paths are opened, and a recording without the topics is refused by the pipeline of the target."""
    (tmp_path / "rig.yaml").write_text(
        "root: a\ntarget: {kind: people}\n"
        "sensors: {a: {kind: lidar2d, topic: /a}, b: {kind: lidar2d, topic: /b}}\n"
    )
    (tmp_path / "recording/c").mkdir(parents=True)
    (tmp_path / "recording/c/1.csv").write_text("")
    with pytest.raises(calgraph.InputError):
        calgraph.calibrate(str(tmp_path / "rig.yaml"), tmp_path / "recording")
