"""Systematic parameters: their file, what the data say of them, and their display."""

import dataclasses
import json
from pathlib import Path

import pytest

from calgraph.result import Calibration, EstimatedParameter, load_calibration, save_calibration, to_json

BIAS = EstimatedParameter("laser", "range bias", "m", stated=0.0, prior=0.02, value=0.0301, stddev=0.0004)
K3 = EstimatedParameter("camera", "k3", "", stated=0.0, prior=0.25, value=0.2, stddev=0.25)
FOCAL = EstimatedParameter("camera", "focal length", "px", stated=800.0, prior=8.0, value=807.912, stddev=4.0)
TAG_Y = EstimatedParameter("tag 3", "y", "m", stated=0.0, prior=0.001, value=-0.00123, stddev=0.0123)
TAG_ROTATION = EstimatedParameter("tag 3", "rotation", "rad", 0.0, prior=0.01, value=-0.0175, stddev=0.00175)


def test_systematic_parameters_are_read_as_written(calibration: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    save_calibration(dataclasses.replace(calibration, systematic=(BIAS, K3)), path)
    assert load_calibration(path).systematic == (BIAS, K3)


def test_files_without_systematic_parameters_do_not_mention_them(calibration: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    save_calibration(calibration, path)
    assert "systematic" not in path.read_text(encoding="utf-8")
    assert load_calibration(path).systematic == ()


def test_parameters_that_version_0_1_estimated_on_request_are_not_read(
    calibration: Calibration, tmp_path: Path
) -> None:
    path = tmp_path / "calibration.yaml"
    save_calibration(calibration, path)
    old = "estimated:\n- {of: laser, quantity: range bias, unit: m, stated: 0.0, value: 0.03, stddev: 0.0004}\n"
    path.write_text(path.read_text(encoding="utf-8") + old, encoding="utf-8")
    assert load_calibration(path).systematic == ()


def test_json_has_all_members(calibration: Calibration) -> None:
    content = json.loads(to_json(dataclasses.replace(calibration, systematic=(BIAS,))))
    assert content["systematic"] == [dataclasses.asdict(BIAS)]


def test_deviation_is_in_prior_standard_deviations() -> None:
    assert FOCAL.deviation == pytest.approx(7.912 / 8)
    assert TAG_ROTATION.deviation == pytest.approx(-1.75)


@pytest.mark.parametrize(
    ("one", "shown"),
    [
        (BIAS, ("0.00", "20", "30.10", "0.40", "mm")),
        (K3, ("0.00", "0.25", "0.20", "0.25", "")),
        (FOCAL, ("800.0", "8", "807.9", "4.0", "px")),
        (TAG_Y, ("0", "1", "-1", "12", "mm")),
        (TAG_ROTATION, ("0.00", "0.57", "-1.00", "0.10", "°")),
    ],
)  # fmt: skip
def test_values_are_formatted_with_two_digits_of_the_standard_deviation(
    one: EstimatedParameter, shown: tuple[str, ...]
) -> None:
    assert one.formatted == shown
