"""What is estimated besides poses: its file, and how it reads."""

import dataclasses
import json
from pathlib import Path

import pytest

from calgraph.result import Calibration, EstimatedParameter, load_calibration, save_calibration, to_json

BIAS = EstimatedParameter("laser", "range bias", "m", 0.0, 0.0301, 0.0004, measured=True)
K3 = EstimatedParameter("camera", "k3", "", 0.0, 0.2, 0.25, measured=False)
FX = EstimatedParameter("camera", "fx", "px", 800.0, 807.912, 12.3, measured=True)
TAG_Y = EstimatedParameter("tag 3", "y", "m", 0.0, -0.00123, 0.0123, measured=True)
TAG_ROTATION = EstimatedParameter("tag 3", "turn", "rad", 0.0, -0.0175, 0.00175, measured=True)


def test_estimated_values_come_back(calibration: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    save_calibration(dataclasses.replace(calibration, estimated_parameters=(BIAS, K3)), path)
    assert load_calibration(path).estimated_parameters == (BIAS, K3)


def test_files_without_estimates_do_not_speak_of_them(calibration: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    save_calibration(calibration, path)
    assert "estimated" not in path.read_text(encoding="utf-8")
    assert load_calibration(path).estimated_parameters == ()


def test_scripts_read_them_from_json(calibration: Calibration) -> None:
    content = json.loads(to_json(dataclasses.replace(calibration, estimated_parameters=(BIAS,))))
    assert content["estimated"] == [dataclasses.asdict(BIAS)]


@pytest.mark.parametrize(
    ("one", "shown"),
    [
        (BIAS, ("0.00", "30.10", "0.40", "mm")),
        (K3, ("0.00", "0.20", "0.25", "")),
        (FX, ("800", "808", "12", "px")),
        (TAG_Y, ("0", "-1", "12", "mm")),
        (TAG_ROTATION, ("0.00", "-1.00", "0.10", "°")),
    ],
)  # fmt: skip
def test_values_are_formatted_with_two_digits_of_the_deviation(
    one: EstimatedParameter, shown: tuple[str, ...]
) -> None:
    assert one.formatted == shown
