"""recording.json: what is written is read again, and what is damaged counts as missing."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calgraph.fleet.recording_result import (
    FILE_NAME,
    PoseSet,
    RecordingResult,
    SensorResult,
    load_result,
    save_result,
)
from calgraph.result import PriorErrors
from fleet_scenes import draw_poses, make_result, make_task, measure_poses


@pytest.fixture
def result(tmp_path: Path) -> RecordingResult:
    poses = measure_poses(draw_poses(), np.random.default_rng(0))
    poses.covariance[8:10] = np.nan
    errors = PriorErrors((("camera", "cx"), ("board", "bow")), np.arange(36.0).reshape(18, 2))
    known = PoseSet(poses.names, poses.T_root_sensor, poses.covariance, errors)
    lost = SensorResult("rear", "camera", "unconnected", "it never detected the board")
    made = make_result(make_task(tmp_path), known)
    return replace(made, sensors=(*made.sensors, lost), reference=poses, warnings=("a warning",))


def test_a_result_is_read_as_it_was_written(result: RecordingResult, tmp_path: Path) -> None:
    save_result(result, tmp_path)
    found = load_result(tmp_path)
    assert found is not None
    assert found.poses is not None
    assert result.poses is not None
    assert (found.sensors, found.warnings, found.start, found.key) == (
        result.sensors, result.warnings, result.start, result.key,
    )  # fmt: skip
    np.testing.assert_array_equal(found.poses.T_root_sensor, result.poses.T_root_sensor)
    np.testing.assert_array_equal(found.poses.covariance, result.poses.covariance)
    assert found.poses.prior_errors is not None
    assert found.poses.prior_errors.parameters == (("camera", "cx"), ("board", "bow"))
    assert found.poses.prior_errors.poses[4, 1] == 9.0
    assert found.lost == ("rear",)


@pytest.mark.parametrize(
    ("key", "value"),
    [("format", "calgraph-fleet-recording/0"), ("sensors", [{"name": "a"}]), ("poses", 3), ("unknown", 1),
     ("failure", {"kind": "bad", "message": ""})],
)  # fmt: skip
def test_a_damaged_result_counts_as_missing(
    result: RecordingResult, tmp_path: Path, key: str, value: object
) -> None:
    save_result(result, tmp_path)
    content = json.loads((tmp_path / FILE_NAME).read_text())
    (tmp_path / FILE_NAME).write_text(json.dumps(content | {key: value}))
    assert load_result(tmp_path) is None


def test_half_a_file_counts_as_missing(result: RecordingResult, tmp_path: Path) -> None:
    save_result(result, tmp_path)
    text = (tmp_path / FILE_NAME).read_text()
    (tmp_path / FILE_NAME).write_text(text[: len(text) // 2])
    assert load_result(tmp_path) is None
