"""calgraph calibrate: files, output, exit codes."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from typer.testing import Result

from calgraph.calibration.dispatch import calibrate
from calgraph.cli.calibrate import fail_if_not_calibrated
from calgraph.config import load_rig
from calgraph.config.settings import AveragingMethod, RigStart
from calgraph.errors import CalibrationError
from calgraph.io.text_writing import save_yaml
from calgraph.recording import RecordingWriter, open_recording
from calgraph.result import BaseFrame, Calibration, SensorPose, Verdict, load_calibration
from calgraph.result.sensor_pose import Grade
from calgraph.sensors import CameraInfo, LaserScan
from calgraph.simulation import load_truth

Run = Callable[..., Result]


def edited(rig: Path, place: Path, old: str, new: str) -> Path:
    """A copy of a rig.yaml with one text replaced."""
    text = rig.read_text()
    assert old in text
    copy = place / "rig.yaml"
    copy.write_text(text.replace(old, new))
    return copy


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_files_are_written(calibrated: tuple[Path, Result]) -> None:
    written = [
        "budget.csv",
        "calibration.yaml",
        "captures.csv",
        "report.html",
        "residuals.csv",
        "rig.resolved.yaml",
        "scene.npz",
    ]
    assert names(calibrated[0]) == written


def test_every_start_can_be_chosen() -> None:
    assert set(get_args(RigStart)) == {"tree", "identity", *get_args(AveragingMethod)}


def test_the_poses_are_those_of_the_robot(calibrated: tuple[Path, Result], simulated: Path) -> None:
    calibration, truth = load_calibration(calibrated[0] / "calibration.yaml"), load_truth(simulated / "truth.yaml")
    errors = [s.T_root_sensor[:3, 3] - truth.T_root_sensor[s.name][:3, 3] for s in calibration.sensors]
    assert len(errors) == 3
    assert np.linalg.norm(errors, axis=1).max() < 0.03


def test_the_json_is_the_whole_result(calibrated: tuple[Path, Result]) -> None:
    content = json.loads(calibrated[1].stdout)
    captures = {(row["capture"], row["sensor"]) for row in content["captures"]}
    assert set(content["sensors"]) == {"lidar", "camera", "laser_front"}
    assert len(content["edges"]) == 3
    assert len(captures) == 9 * 3


def test_nothing_but_json_is_printed_where_there_is_no_terminal(calibrated: tuple[Path, Result]) -> None:
    assert calibrated[1].stderr == ""


def test_the_resolved_rig_states_the_intrinsics_of_the_recording(calibrated: tuple[Path, Result]) -> None:
    camera = load_rig(calibrated[0] / "rig.resolved.yaml").cameras()["camera"]
    assert camera.stated_intrinsics is not None
    np.testing.assert_allclose(camera.stated_intrinsics.K, (240, 240, 239.5, 179.5))


@pytest.mark.slow
def test_what_is_wrong_with_the_messages_is_remarked_and_makes_sensors_weak(
    simulated: Path, tmp_path: Path, run: Run
) -> None:
    """A relay of the laser, a camera that zooms, and a slip in a frame_id."""
    rig = load_rig(simulated / "rig.yaml").to_plain()
    laser, info = rig["sensors"]["laser_front"]["topic"], rig["sensors"]["camera"]["camera_info"]
    rig["sensors"]["relay"] = {"kind": "lidar2d", "topic": "/relay", "frame_id": "relay"}
    rig["sensors"]["lidar"]["frame_id"] = "lidra"
    save_yaml(tmp_path / "rig.yaml", rig)
    with open_recording(simulated / "recording") as before, RecordingWriter(tmp_path / "recording") as writer:
        for record in before.records():
            message = record.decode()
            writer.write(record.topic, message, record.arrival)
            if record.topic == laser:
                assert isinstance(message, LaserScan)
                writer.write("/relay", replace(message, frame_id="relay"), record.arrival)
            if isinstance(message, CameraInfo):
                zoomed = replace(message.camera, K=message.camera.K * [[1.05], [1.05], [1]])
                later = replace(message, stamp=message.stamp + 2, camera=zoomed)
                writer.write(info, later, record.arrival + 2)
    result = run("calibrate", tmp_path / "rig.yaml", tmp_path / "recording", "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    found = load_calibration(tmp_path / "out/calibration.yaml")
    frame, copy, zoom = found.evidence.remarks[:3]
    assert "rig.yaml states lidra" in frame
    assert "laser_front and relay have the same data, 100 % of their messages" in copy
    assert "the intrinsics of camera on /camera/camera_info change at 2." in zoom
    assert "(fx 240 to 252 pixels)" in zoom
    for name, reason in (("laser_front", copy), ("relay", copy), ("camera", zoom)):
        assert found[name].verdict.grade == "weak"
        assert found[name].verdict.reason.startswith(reason)


def test_a_right_recording_has_no_remarks_on_its_messages(calibrated: tuple[Path, Result]) -> None:
    remarks = load_calibration(calibrated[0] / "calibration.yaml").evidence.remarks
    assert not [remark for remark in remarks if "messages" in remark or "intrinsics" in remark]


def test_an_unconnected_sensor_is_named_and_the_others_are_written(
    simulated: Path, tmp_path: Path, run: Run
) -> None:
    rig = edited(simulated / "rig.yaml", tmp_path, "tag36h11", "tag25h9")
    result = run("calibrate", rig, simulated / "recording", "-o", tmp_path / "out")
    assert result.exit_code == 1
    assert result.stderr.startswith("calgraph: camera is not calibrated: ")
    assert [s.name for s in load_calibration(tmp_path / "out" / "calibration.yaml").sensors] == [
        "lidar",
        "laser_front",
    ]


def test_without_captures_nothing_is_written(simulated: Path, tmp_path: Path, run: Run) -> None:
    rig = edited(simulated / "rig.yaml", tmp_path, "exclude: []", "exclude: [[0.0, 1000.0]]")
    result = run("calibrate", rig, simulated / "recording", "-o", tmp_path / "out")
    assert (result.exit_code, result.stderr.count("\n")) == (1, 1)
    assert names(tmp_path) == ["rig.yaml"]


def test_a_wrong_key_is_named_with_its_file(simulated: Path, tmp_path: Path, run: Run) -> None:
    rig = edited(simulated / "rig.yaml", tmp_path, "trigger: /trigger", "trigggr: /trigger")
    result = run("calibrate", rig, simulated / "recording", "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert result.stderr == f"calgraph: {rig}: unknown key capture.trigggr; did you mean 'trigger'?\n"


def test_a_topic_that_is_not_recorded_is_named(simulated: Path, tmp_path: Path, run: Run) -> None:
    rig = edited(simulated / "rig.yaml", tmp_path, "/laser_front/scan", "/laser_font/scan")
    result = run("calibrate", rig, simulated / "recording", "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert "has no topic '/laser_font/scan'; did you mean '/laser_front/scan'?" in result.stderr


def test_a_missing_recording_is_named(simulated: Path, tmp_path: Path, run: Run) -> None:
    result = run("calibrate", simulated / "rig.yaml", tmp_path / "none", "-o", tmp_path / "out")
    assert (result.exit_code, result.stderr) == (
        2,
        f"calgraph: {tmp_path / 'none'}: does not exist; check the path\n",
    )


def test_a_truncated_recording_is_bad_input(simulated: Path, tmp_path: Path, run: Run) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes((simulated / "recording" / "recording.mcap").read_bytes()[:100_000])
    result = run("calibrate", simulated / "rig.yaml", cut, "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert result.stderr.startswith(f"calgraph: {cut}: ")
    assert names(tmp_path) == ["cut.mcap"]


def test_an_unusable_output_path_is_an_error_before_the_recording_is_opened(
    simulated: Path, tmp_path: Path, run: Run
) -> None:
    (tmp_path / "out").write_text("a file")
    result = run("calibrate", simulated / "rig.yaml", tmp_path / "none", "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert result.stderr == f"calgraph: {tmp_path / 'out'}: is a file, a folder is to be written there\n"


def test_a_place_below_a_file_is_unusable(simulated: Path, tmp_path: Path, run: Run) -> None:
    (tmp_path / "file").write_text("a file")
    result = run("calibrate", simulated / "rig.yaml", tmp_path / "none", "-o", tmp_path / "file" / "out")
    assert result.exit_code == 2
    assert "file/out: cannot be written (" in result.stderr


def test_a_missing_option_is_bad_usage(simulated: Path, run: Run) -> None:
    assert run("calibrate", simulated / "rig.yaml", simulated / "recording").exit_code == 2


def test_an_interrupted_run_leaves_nothing_and_prints_nothing(simulated: Path, tmp_path: Path) -> None:
    assert stopped(simulated, tmp_path, signal.SIGINT) == (130, "", [])


def test_a_terminated_run_leaves_nothing(simulated: Path, tmp_path: Path) -> None:
    assert stopped(simulated, tmp_path, signal.SIGTERM) == (143, "", [])


def stopped(simulated: Path, place: Path, by: signal.Signals) -> tuple[int, str, list[str]]:
    """Exit code, stderr and files left when a calibration is stopped while it works."""
    # A shell starts background jobs, as CI may be one, with Ctrl-C ignored; children inherit that.
    heed = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    code = f"{heed}; from calgraph.cli import main; main()"
    arguments = ["calibrate", simulated / "rig.yaml", simulated / "recording", "-o", place / "out"]
    with subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)], stderr=subprocess.PIPE, text=True
    ) as process:
        deadline = time.monotonic() + 60
        while not names(place) and time.monotonic() < deadline:
            time.sleep(0.05)
        process.send_signal(by)
        _, stderr = process.communicate(timeout=60)
    return process.returncode, stderr, names(place)


@pytest.mark.parametrize(("grade", "strict"), [("unobservable", False), ("weak", True)])
def test_a_frame_of_the_vehicle_counts_as_a_sensor_does(grade: Grade, strict: bool) -> None:
    root = SensorPose("lidar", None, "lidar", "lidar3d", np.eye(4), Verdict("good"))
    base = BaseFrame("base_link", "rear", Verdict(grade, "no floor"))
    with pytest.raises(CalibrationError, match=r"^base_link is (not calibrated|weak)"):
        fail_if_not_calibrated(Calibration("lidar", (root,), np.zeros((6, 6)), base=base), strict=strict)


def test_python_finds_what_the_command_wrote(simulated: Path, calibrated: tuple[Path, Result]) -> None:
    found = calibrate(simulated / "rig.yaml", simulated / "recording")
    for sensor in load_calibration(calibrated[0]).sensors:
        np.testing.assert_allclose(found[sensor.name].T_root_sensor, sensor.T_root_sensor, atol=1e-6)
        assert sensor.name in repr(found)
        assert f"<td>{sensor.name}</td>" in found._repr_html_()
