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
