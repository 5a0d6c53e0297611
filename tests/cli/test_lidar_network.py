"""Commands for networks of 3-D LiDARs: a simulated hall is calibrated, and checked."""

from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import Result

Run = Callable[..., Result]


@pytest.mark.slow
def test_commands_calibrate_and_check_lidars(run: Run, tmp_path: Path) -> None:
    made = run("simulate", "network", "--lidars", "2", "--duration", "20", "-o", tmp_path / "hall")
    assert made.exit_code == 0, made.output
    inputs = (tmp_path / "hall" / "rig.yaml", tmp_path / "hall" / "recording")
    calibrated = run("calibrate", *inputs, "-o", tmp_path / "result")
    assert calibrated.exit_code == 0, calibrated.output
    for name in ("calibration.yaml", "report.html", "captures.csv", "residuals.csv", "scene.npz"):
        assert (tmp_path / "result" / name).is_file()
    checked = run("check", *inputs, "--against", tmp_path / "result" / "calibration.yaml")
    assert checked.exit_code == 0, checked.output
    assert "lidar_2: " in checked.output


@pytest.mark.slow
def test_commands_calibrate_a_mixed_network_in_the_frame_of_a_scanner(run: Run, tmp_path: Path) -> None:
    """Its stated height and tilt decide what is known of the others; earlier poses have to be relative to it."""
    made = run(
        "simulate", "network", "--lidars", "2", "--scanners", "1", "--duration", "20", "-o", tmp_path / "hall"
    )
    assert made.exit_code == 0, made.output
    rig, recording, result = tmp_path / "hall" / "rig.yaml", tmp_path / "hall" / "recording", tmp_path / "result"
    text = rig.read_text()
    assert text.count("tilt: 2.0") == text.count("root: lidar_1") == 1
    rig.write_text(text.replace("tilt: 2.0", "tilt: 0.2").replace("root: lidar_1", "root: scanner_1"))
    calibrated = run("calibrate", rig, recording, "-o", result)
    assert calibrated.exit_code == 0, calibrated.output
    assert "Poses in the frame of scanner_1" in calibrated.output
    assert "the root scanner_1 measures do not show its height, roll and pitch" in calibrated.output
    exported = run("export", result / "calibration.yaml", "--force", "--format", "tf", "-o", tmp_path / "tf.yaml")
    assert exported.exit_code == 0, exported.output
    assert (tmp_path / "tf.yaml").read_text().count("frame_id: scanner_1\n") == 2
    extend = ("calibrate", rig, recording, "-o", tmp_path / "more", "--extend", result / "calibration.yaml")
    moved = run(*extend, "--moved", "lidar_1", "--moved", "lidar_2")
    assert moved.exit_code == 2
    assert "--extend: has none of lidar_1, lidar_2 where it was" in moved.output
    rig.write_text(text)
    other = run(*extend)
    assert other.exit_code == 2
    assert "set root: scanner_1 in rig.yaml" in other.output
