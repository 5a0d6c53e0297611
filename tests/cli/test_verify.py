"""``calgraph verify``: ratios by sensor and axis, from a dump, and in words that scripts can read."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

from calgraph.rig.bundle.problem_file import save_problem
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures
from calgraph.simulation import CameraOptions, LaserOptions, RigScenario, build_world
from ideal_detections import simulate_detections

Run = Callable[..., Result]


@pytest.fixture(scope="module")
def dump(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The joint problem of a camera and two scanners."""
    camera = CameraOptions(width=640, height=480, texels_per_mm=0.5)
    stage = build_world(RigScenario(camera=camera, laser=LaserOptions(count=1), radii=(2.0,), samples=1), 3)
    rig, captured, _ = simulate_detections(stage, 0)
    path = tmp_path_factory.mktemp("dump") / "problem.npz"
    save_problem(build_problem_from_captures(rig, captured, RigOptions(), np.random.default_rng(0)), path)
    return path


def test_every_axis_of_every_sensor_but_the_root_has_a_ratio_and_an_interval(dump: Path, run: Run) -> None:
    result = run("verify", dump, "--rounds", 20, "--json")
    content = json.loads(result.stdout)
    assert content["format"] == "calgraph-verify/1"
    assert set(content["sensors"]) == {"camera", "laser_front"}
    for sensor in content["sensors"].values():
        assert sensor["verdict"] in ("honest", "optimistic", "pessimistic")
        assert all(axis["interval"][0] < axis["ratio"] < axis["interval"][1] for axis in sensor["axes"])
    optimistic = [s for s in content["sensors"].values() if s["verdict"] == "optimistic"]
    assert result.exit_code == (1 if optimistic else 0), result.output


def test_a_rig_without_a_recording_is_refused(tmp_path: Path, run: Run) -> None:
    result = run("verify", tmp_path / "rig.yaml")
    assert result.exit_code == 2
    assert "needs a recording beside it" in result.output
