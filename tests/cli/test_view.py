"""calgraph view: the result in the browser, and errors of unusable results."""

import sys
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import Result

from calgraph.result import load_calibration, load_scene
from calgraph.viewer import Viewer

Run = Callable[..., Result]


@pytest.fixture
def out(calibrated: tuple[Path, Result]) -> Path:
    return calibrated[0]


@pytest.fixture
def interrupted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Ends serving as Ctrl-C does, once the page was fetched; the answers are in the list."""
    pytest.importorskip("viser", reason="the extra view is not installed")
    answers: list[int] = []

    def serve(self: Viewer) -> None:
        with urllib.request.urlopen(self.url) as answer:
            answers.append(answer.status)
        raise KeyboardInterrupt

    monkeypatch.setattr(Viewer, "serve", serve)
    return answers


def test_a_result_is_shown_until_it_is_interrupted(run: Run, out: Path, interrupted: list[int]) -> None:
    result = run("view", out, "--no-browser", "--port", 8137)
    assert result.exit_code == 0, result.output
    assert f"{out} is shown at http://127.0.0.1:81" in result.stdout
    assert "viser" not in result.stdout
    assert interrupted == [200]


def test_the_page_is_opened(run: Run, out: Path, interrupted: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    run("view", out, "--port", 8237)
    assert len(interrupted) == len(opened) == 1
    assert opened[0].startswith("http://127.0.0.1:82")


def test_calibrate_keeps_snapshots_of_every_sensor(out: Path) -> None:
    """Of the nine captures of the simulated recording: a picture of the camera's size, scans and clouds."""
    calibration, pictures = load_calibration(out / "calibration.yaml"), load_scene(out / "scene.npz")
    captures = {row.capture for row in calibration.evidence.captures}
    seen = {(s.capture, s.sensor) for s in pictures.snapshots}
    assert seen == {(capture, sensor.name) for capture in captures for sensor in calibration.sensors}
    assert {s.picture.shape for s in pictures.snapshots if s.sensor == "camera"} == {(360, 480, 3)}
    assert min(len(s.points) for s in pictures.snapshots if s.sensor != "camera") > 100
    assert {view.sensor for view in pictures.board_views} == {sensor.name for sensor in calibration.sensors}


def test_a_folder_that_is_none_is_named(run: Run, tmp_path: Path) -> None:
    result = run("view", tmp_path / "nowhere")
    assert result.exit_code == 2
    assert "is no folder; give the one that calibrate wrote with -o" in result.stderr


def test_a_result_without_a_scene_is_an_error(run: Run, out: Path, tmp_path: Path) -> None:
    for name in ("calibration.yaml", "rig.resolved.yaml"):
        (tmp_path / name).write_bytes((out / name).read_bytes())
    result = run("view", tmp_path)
    assert result.exit_code == 2
    assert "scene.npz: cannot be read" in result.stderr


def test_without_viser_the_command_to_install_it_is_given(
    run: Run, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    result = run("view", out, "--no-browser")
    assert result.exit_code == 2
    assert 'pip install "calgraph[view]"' in result.stderr
