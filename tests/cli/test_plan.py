"""``calgraph plan``: errors before a recording, as a table and as JSON, and what it assumes."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import Result

Run = Callable[..., Result]

RIG = """
root: left
target:
  kind: board
  size: [1.0, 0.8]
  family: tag36h11
  tags: [{{id: 3, size: 0.30, center: [-0.28, 0.16]}}, {{id: 4, size: 0.30, center: [0.28, -0.16]}}]
  uncertainty: {{print_scale: {print_scale}}}
sensors:
  left: {{kind: camera, topic: /left, camera_info: /left/info, frame_id: left_optical}}
  right: {{kind: camera, topic: /right, camera_info: /right/info}}
"""
POSES = """
- {frame_id: left_optical, child_frame_id: right, translation: [0.6, 0, 0], rotation: [0, 0, 0, 1]}
"""


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    path = tmp_path / "rig.yaml"
    path.write_text(RIG.format(print_scale=0.05), encoding="utf-8")
    return path


def test_what_more_captures_cannot_improve_is_stated(rig: Path, run: Run) -> None:
    result = run("plan", rig)
    assert result.exit_code == 0, result.output
    assert (
        "right: more captures cannot help: with any number of them, sideways (x) is uncertain by 29 mm"
        in result.output
    )
    # The only uncertainty of 5 %: those of the lenses are of 1 %.
    assert "the largest source of it: print scale of board (100 %)" in result.output
    assert "1. hold the board" in result.output
    assert "assumed, as not stated: left: 1280 x 960 pixels, 70° wide" in result.output
    assert "assumed, as not stated: poses: sensors side by side" in result.output


def test_captures_that_suffice_are_stated(rig: Path, run: Run) -> None:
    rig.write_text(RIG.format(print_scale=0.001), encoding="utf-8")
    result = run("plan", rig, "--captures", 300)
    assert result.exit_code == 0, result.output
    assert "Predicted errors of 300 captures" in result.output
    assert "captures suffice for all sensors, with a reserve of 10 % if possible" in result.output
    assert "cannot help" not in result.output


def test_poses_of_a_file_take_the_place_of_the_assumed_ones(rig: Path, run: Run) -> None:
    poses = rig.with_name("poses.yaml")
    poses.write_text(POSES, encoding="utf-8")
    result = run("plan", rig, "--poses", poses, "--json")
    plan = json.loads(result.stdout)
    assert plan["format"] == "calgraph-plan/1"
    assert plan["captures"] == 40
    # As uncertain as the print, over 0.6 m instead of 0.3 m.
    assert plan["sensors"]["right"]["axes"][0]["limit"] == pytest.approx(0.03, rel=0.1)
    assert not any("poses" in one for one in plan["assumptions"])


def test_a_network_is_refused(tmp_path: Path, run: Run) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(
        "root: a\ntarget: {kind: people}\nsensors:\n  a: {kind: lidar2d, topic: /a}\n", encoding="utf-8"
    )
    result = run("plan", path)
    assert result.exit_code == 2
    assert "target.kind: must be board" in result.output
