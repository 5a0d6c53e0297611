"""``calgraph fleet``: three robots, of which one moved and one is broken; stopped, repeated, and checked."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

from calgraph.geometry import se3
from calgraph.io.text_writing import save_yaml
from calgraph.result import load_calibration, save_calibration

pytestmark = pytest.mark.slow

Run = Callable[..., Result]


@pytest.fixture(scope="module")
def fleet(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a fleet: ``good`` has one recording twice, that of ``broken`` is empty; not to be changed."""
    folder = tmp_path_factory.mktemp("fleet")
    for robot, days in (("good", 2), ("broken", 1)):
        for day in range(days):
            shutil.copytree(simulated, folder / robot / f"day-{day}")
    next((folder / "broken" / "day-0" / "recording").glob("*.mcap")).write_bytes(b"")
    content = {
        "rig": "{robot}/day-0/rig.yaml",
        "recordings": ["{robot}/day-*/recording"],
        "robots": {"good": {}, "broken": {}, "absent": {}},
    }
    save_yaml(folder / "fleet.yaml", content)
    return folder


@pytest.fixture(scope="module")
def first(fleet: Path, run: Run) -> Result:
    """The first run, whose results are in ``fleet/out``."""
    return run("fleet", fleet / "fleet.yaml", "-o", fleet / "out", "--jobs", 1, "--json")


def changed(out: Path) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in out.rglob("recording.json")}


def test_failures_are_named_and_the_others_are_calibrated(first: Result, fleet: Path) -> None:
    assert first.exit_code == 1
    robots = json.loads(first.stdout)["robots"]
    assert robots["good"]["states"] == ["good"] or robots["good"]["states"] == ["weak"]
    assert robots["good"]["moved"] == []
    (failure,) = robots["broken"]["failures"]
    assert failure["kind"] == "input"
    assert "is empty" in failure["message"]
    assert robots["absent"]["failures"][0]["message"] == "no recording matches absent/day-*/recording"
    assert "2 of 3 robots need attention: broken, absent" in first.stderr
    page = (fleet / "out" / "index.html").read_text()
    assert page.count("<tr data-states=") == 3
    for day in (0, 1):
        assert (fleet / "out" / "robots" / "good" / f"day-{day}_recording" / "report.html").exists()


@pytest.mark.usefixtures("first")
def test_results_are_those_of_calibrate(fleet: Path, calibrated: tuple[Path, Result]) -> None:
    alone = load_calibration(calibrated[0] / "calibration.yaml")
    found = load_calibration(fleet / "out" / "robots" / "good" / "day-1_recording" / "calibration.yaml")
    assert [(one.T_root_sensor == other.T_root_sensor).all() for one, other in
            zip(alone.sensors, found.sensors, strict=True)] == [True] * len(alone.sensors)  # fmt: skip


@pytest.mark.usefixtures("first")
def test_a_second_run_repeats_nothing(fleet: Path, run: Run) -> None:
    before = changed(fleet / "out")
    result = run("fleet", fleet / "fleet.yaml", "-o", fleet / "out")
    assert changed(fleet / "out") == before
    assert "3 recordings had results of an earlier run" in " ".join(result.stdout.split())


@pytest.mark.usefixtures("first")
def test_what_was_under_way_is_repeated_and_failures_on_demand(fleet: Path, run: Run) -> None:
    before = changed(fleet / "out")
    lost = fleet / "out" / "robots" / "good" / "day-0_recording" / "recording.json"
    lost.unlink()
    run("fleet", fleet / "fleet.yaml", "-o", fleet / "out", "--retry-failed")
    repeated = {Path(path).parent.name for path, time in changed(fleet / "out").items() if time != before[path]}
    assert repeated == {"day-0_recording"}
    after = changed(fleet / "out")
    assert {Path(path).parent.parent.name for path in before if after[path] != before[path]} == {"good", "broken"}


@pytest.mark.usefixtures("first")
def test_check_compares_each_recording_with_the_reference(fleet: Path, run: Run) -> None:
    found = load_calibration(fleet / "out" / "robots" / "good" / "day-1_recording" / "calibration.yaml")
    camera = found["camera"]
    elsewhere = replace(camera, T_root_sensor=se3.retract(camera.T_root_sensor, np.array([0, 0.05, 0, 0, 0, 0])))
    sensors = tuple(elsewhere if one.name == "camera" else one for one in found.sensors)
    save_calibration(replace(found, sensors=sensors), fleet / "reference.yaml")
    content = {
        "rig": "{robot}/day-0/rig.yaml",
        "recordings": ["{robot}/day-0/recording"],
        "action": "check",
        "reference": "reference.yaml",
        "robots": {"good": {}},
    }
    save_yaml(fleet / "check.yaml", content)
    result = run("fleet", fleet / "check.yaml", "-o", fleet / "checked", "--json")
    assert result.exit_code == 1
    robot = json.loads(result.stdout)["robots"]["good"]
    assert {"moved", "off"} <= set(robot["states"])
    (move,) = robot["moved"]
    assert (move["earlier"], move["sensors"]) == ("reference", ["camera"])
    assert move["distance"] == pytest.approx(0.05, abs=0.01)
    assert (fleet / "checked" / "robots" / "good" / "day-0_recording" / "check.json").exists()


def test_an_out_that_is_a_file_is_refused(fleet: Path, run: Run) -> None:
    result = run("fleet", fleet / "fleet.yaml", "-o", fleet / "fleet.yaml")
    assert result.exit_code == 2
    assert "is a file, a folder is to be written there" in result.stderr


def test_a_cluster_gives_the_same_results(first: Result, fleet: Path, run: Run, tmp_path: Path) -> None:
    on_cluster = run(
        "fleet", fleet / "fleet.yaml", "-o", tmp_path / "out", "--cluster", "local", "--jobs", 2, "--json"
    )
    assert json.loads(on_cluster.stdout) == json.loads(first.stdout)
    same = Path("robots", "good", "day-1_recording", "residuals.csv")
    assert (tmp_path / "out" / same).read_bytes() == (fleet / "out" / same).read_bytes()
