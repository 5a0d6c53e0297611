"""calgraph inspect: the table, its JSON, and damaged recordings."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

from calgraph.recording import RecordingWriter, open_recording
from calgraph.result import load_calibration
from calgraph.sensors import CameraInfo, CameraModel, LaserScan, Trigger

Run = Callable[..., Result]


@pytest.fixture(scope="module")
def printed(run: Run, simulated: Path) -> str:
    return run("inspect", simulated / "recording").stdout


def test_every_topic_is_listed_with_its_count(printed: str, simulated: Path) -> None:
    with open_recording(simulated / "recording") as recording:
        counts = {topic.name: str(topic.count) for topic in recording.topics}
    table, _, _ = printed.partition("gap: ")
    rows = (line.split() for line in table.splitlines()[1:] if line.startswith("/"))
    assert {row[0]: row[1] for row in rows} == counts


def test_the_first_message_is_described(printed: str) -> None:
    assert "/laser_front/scan: LaserScan, lidar2d, frame laser_front" in printed
    assert "480 x 360 pixels, grey" in printed


def test_what_is_not_used_is_listed_with_its_whole_type_and_why(run: Run, tmp_path: Path) -> None:
    camera = CameraModel("pinhole", 4, 3, np.diag([5.0, 5, 1]), np.zeros(5))
    with RecordingWriter(tmp_path / "bag") as writer:
        for k in range(5):
            writer.write("/scan", LaserScan(k / 10, "laser", np.linspace(-1, 1, 11), np.full(11, 2.0)))
            writer.write("/note", Trigger(k / 10))
            writer.write("/rear/camera_info", CameraInfo(k / 10, "rear", camera))
    printed = run("inspect", tmp_path / "bag").stdout.splitlines()
    for name, ros_type, why in (
        ("/note", "std_msgs/msg/Header", "has not the name of a trigger"),
        ("/rear/camera_info", "sensor_msgs/msg/CameraInfo", "is of no camera whose images are used"),
    ):
        [line] = [line for line in printed if line.startswith(f"{name}: ")]
        assert line.startswith(f"{name}: {ros_type}")
        assert f"not used: {why}" in line
        assert why in json.loads(run("inspect", tmp_path / "bag", "--json").stdout)["unused"][name]


def test_a_sound_recording_has_no_anomalies(printed: str) -> None:
    assert printed.endswith("No anomalies were found.\n")


def test_the_json_has_the_rates_of_the_sensors(run: Run, simulated: Path) -> None:
    content = json.loads(run("inspect", simulated / "recording", "--json").stdout)
    rates = {topic["name"]: topic["timing"]["rate"] for topic in content["topics"]}
    assert rates["/camera/image_raw/compressed"] == pytest.approx(4, abs=0.01)
    assert rates["/laser_front/scan"] == pytest.approx(10, abs=0.01)


def test_a_truncated_file_is_bad_input(run: Run, simulated: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes((simulated / "recording" / "recording.mcap").read_bytes()[:100_000])
    result = run("inspect", tmp_path / "cut.mcap")
    assert result.exit_code == 2
    assert result.stderr.startswith(f"calgraph: {tmp_path / 'cut.mcap'}: ")


def test_missing_messages_are_reported_after_the_table(run: Run, simulated: Path, tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    for file in (simulated / "recording").iterdir():
        (tmp_path / "bag" / file.name).write_bytes(file.read_bytes())
    metadata = tmp_path / "bag" / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 9\n", "message_count: 11\n"))
    result = run("inspect", tmp_path / "bag")
    assert result.exit_code == 2
    assert "! /trigger: holds 9 messages, the recording states 11" in result.stdout
    assert "holds fewer messages than it states (/trigger: 9 of 11)" in result.stderr


def test_limits_are_settings_of_the_command(run: Run, simulated: Path) -> None:
    result = run("inspect", simulated / "recording", "--set", "limits.max_image_pixels=1e5")
    assert "image states 480 x 360 pixels, more than the limit of 100000" in " ".join(result.stdout.split())
    result = run("inspect", simulated / "recording", "--set", "captures.min_hold=1")
    assert result.exit_code == 2
    assert "only limits are of use here" in result.stderr


def test_the_sources_of_a_pair_add_up_to_its_covariance(run: Run, calibrated: tuple[Path, Result]) -> None:
    out, result = calibrated
    for a, b in (("camera", "laser_front"), ("laser_front", "camera")):
        content = json.loads(run("inspect", out, "--pair", a, b, "--json").stdout)
        assert content["pair"] == [a, b]
        expected = load_calibration(out / "calibration.yaml").covariance(a, b)
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        total = np.sum([one["covariance"] for one in content["budget"]], axis=0)
        np.testing.assert_allclose(total / scale, expected / scale, rtol=0, atol=1e-9)
    sources = {(one["source"], one["of"]) for one in content["budget"]}
    assert {("noise", "camera"), ("range bias", "lidar"), ("print scale", "board")} <= sources
    whole = json.loads(result.stdout)["budget"]
    assert {(one["source"], one["of"]) for one in whole} == sources
    variances = np.sum([np.square(one["stddev"]["camera"]) for one in whole], axis=0)
    pose = load_calibration(out / "calibration.yaml")["camera"]
    np.testing.assert_allclose(variances, pose.axis_stddev**2, rtol=1e-6)


def test_a_result_is_shown_with_what_its_uncertainty_comes_from(run: Run, calibrated: tuple[Path, Result]) -> None:
    lines = run("inspect", calibrated[0]).stdout.splitlines()
    title = next(k for k, line in enumerate(lines) if line.startswith("Where the uncertainty comes from"))
    assert {line.split()[0] for line in lines[title + 2 :] if line[:1].isalpha()} == {"camera", "laser_front"}
    of_pair = run("inspect", calibrated[0], "--pair", "camera", "lidar").stdout.splitlines()
    assert of_pair[0].startswith("Where the uncertainty of lidar in the frame of camera comes from")
    assert sum(line.startswith("lidar ") for line in of_pair) == 6


def test_a_pair_is_of_a_result(run: Run, simulated: Path) -> None:
    result = run("inspect", simulated / "recording", "--pair", "camera", "lidar")
    assert result.exit_code == 2
    assert "has no calibration.yaml; give the folder that calibrate wrote" in " ".join(result.stderr.split())
