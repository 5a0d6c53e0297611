"""--verbose: steps with counts and times on stderr, and nothing else changes."""

import logging
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from typer.testing import Result

pytestmark = pytest.mark.slow

Run = Callable[..., Result]


@pytest.fixture(autouse=True)
def _logging_as_before() -> Iterator[None]:
    root = logging.getLogger()
    before = root.handlers[:], root.level
    yield
    root.handlers[:], level = before
    root.setLevel(level)


@pytest.mark.parametrize("where", [["-v", "calibrate"], ["calibrate", "--verbose"]])
def test_steps_are_logged_with_counts_and_times(
    run: Run, simulated: Path, tmp_path: Path, where: list[str]
) -> None:
    files = [simulated / "rig.yaml", simulated / "recording", "-o", tmp_path / "result", "--json"]
    result = run(*where, *files)
    steps = re.findall(r"^calgraph: +\d+\.\d s  (.*)$", result.stderr, re.MULTILINE)
    assert len(steps) == len(result.stderr.splitlines())
    text = "\n".join(steps)
    for expected in (
        r"^recording: \d+\.\d s, \d+ messages$",
        r"^detecting: done in \d+\.\d s$",
        r"^captures: 9$",
        r"^detections of camera: in \d of 9 captures",
        r"^pair lidar, laser_front: \d inliers of \d matches$",
        r"^joint solution: 3 sensors, 9 boards, \d+ further parameters, \d+ detections, 0 of them rejected; ",
        r"^results: written$",
    ):
        assert re.search(expected, text, re.MULTILINE), expected


def test_without_it_nothing_is_logged(calibrated: tuple[Path, Result]) -> None:
    assert calibrated[1].stderr == ""


def test_tracks_of_a_network_are_counted(run: Run, tmp_path: Path) -> None:
    network = tmp_path / "network"
    run("simulate", "network", "-o", network, "--layout", "lab", "--duration", "8")
    result = run("calibrate", network / "rig.yaml", network / "recording", "-o", tmp_path / "result", "-v")
    for expected in (
        r"tracks of \w+: \d+$",
        r"pair \w+, \w+: \d+ possible poses$",
        r"start poses: \d scanners from \d+ poses of pairs$",
        r"joint solution: \d scanners, with clocks$",
    ):
        assert re.search(expected, result.stderr, re.MULTILINE), expected
