"""A depth camera beside a camera and a 2-D scanner: from the recording to a pose and its verdict."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from calgraph.cli.app import app
from calgraph.geometry import Array, se3, so3
from calgraph.recording import MessageRecording
from calgraph.result import SensorPose
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import calibrate_rig
from calgraph.sensors import CameraInfo, Message, Trigger
from calgraph.simulation.rig_scenario import (
    CameraOptions,
    DepthOptions,
    LaserOptions,
    RigScenario,
    SpinningOptions,
)
from calgraph.simulation.rig_simulation import TRIGGER_TOPIC, simulate_rig, topic_of, world_rig
from calgraph.simulation.robot import MountedScanner
from calgraph.simulation.world import build_world, ground_truth
from simulated_captures import simulate_background, simulate_captures


def scenario(radii: tuple[float, ...] = (1.3, 2.0), **depth: float) -> RigScenario:
    return RigScenario(
        camera=CameraOptions(width=960, height=720),
        laser=LaserOptions(count=1),
        spinning=SpinningOptions(count=0),
        depth=DepthOptions.model_validate({"count": 1, **depth}),
        bearings=(-25, -15, -5, 5, 15, 25),
        radii=radii,
        samples=2,
        background=2.0,
        root="camera",
    )


def calibrated(seed: int, drawn: RigScenario) -> tuple[SensorPose, Array]:
    """The depth camera's pose, and the error of its translation (m) and rotation (rad), in the root's axes."""
    world = build_world(drawn, seed)
    messages: dict[str, list[Message]] = {}
    background = simulate_background(world)
    for sensor in world.robot:
        messages[topic_of(sensor, drawn)] = list(background[sensor.name])
        if not isinstance(sensor, MountedScanner):
            info = CameraInfo(drawn.start_time, sensor.frame_id, sensor.camera)
            messages[f"/{sensor.name}/camera_info"] = [info]
    for capture in simulate_captures(world):
        for sensor in world.robot:
            messages[topic_of(sensor, drawn)] += capture.messages[sensor.name]
    messages[TRIGGER_TOPIC] = [Trigger(drawn.start_time + hold.start) for hold in world.trajectory.holds]
    found = calibrate_rig(world_rig(world), MessageRecording(messages), RigOptions())["depth"]
    T_error = found.T_root_sensor @ se3.inverse(ground_truth(world).T_root_sensor["depth"])
    shift = found.T_root_sensor[:3, 3] - ground_truth(world).T_root_sensor["depth"][:3, 3]
    return found, np.concatenate([shift, so3.log(T_error[:3, :3])])


def test_a_depth_camera_is_calibrated_to_a_millimetre_within_its_covariance() -> None:
    found, error = calibrated(1, scenario())
    assert found.kind == "depth_camera"
    assert np.linalg.norm(error[:3]) < 0.003
    assert np.degrees(np.linalg.norm(error[3:])) < 0.1
    assert error @ np.linalg.solve(found.covariance, error) < 16.8  # 99 % of χ² with 6 degrees of freedom


@pytest.mark.slow
@pytest.mark.parametrize("warp", [0.0, 0.002])
def test_errors_of_several_depth_cameras_are_as_stated(warp: float) -> None:
    nees = []
    for seed in range(6):
        found, error = calibrated(seed, scenario(warp=warp))
        nees.append(error @ np.linalg.solve(found.covariance, error) / 6)
        assert found.verdict.grade != "good" or np.linalg.norm(error[:3]) < 0.01
    assert 0.3 < np.mean(nees) < 2.0
    assert np.max(nees) < 3.5


def test_a_recording_is_drafted_inspected_and_calibrated(tmp_path: Path) -> None:
    drawn = scenario(radii=(1.5,))
    simulate_rig(drawn, tmp_path, seed=2)
    recording, run = str(tmp_path / "recording"), CliRunner()
    board = tmp_path / "rig.yaml"
    inspected = run.invoke(app, ["inspect", recording])
    assert inspected.exit_code == 0, inspected.output
    assert "depth_camera" in inspected.output
    drafted = run.invoke(app, ["init", recording, "--board", str(board), "-o", str(tmp_path / "drafted.yaml")])
    assert drafted.exit_code == 0, drafted.output
    command = ["calibrate", str(tmp_path / "drafted.yaml"), recording, "-o", str(tmp_path / "out"), "--json"]
    done = run.invoke(app, command)
    assert done.exit_code == 0, done.output
    assert set(json.loads(done.stdout)["sensors"]) == {"camera", "depth", "laser_front"}
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "depth camera" in report
