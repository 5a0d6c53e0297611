"""calgraph simulate network: its knobs, its files, and what it says of wrong values."""

from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from calgraph.cli.app import app
from calgraph.cli.simulate_network import _MODEL_OPTIONS
from calgraph.io.yaml_reading import read_yaml
from calgraph.recording import open_recordings
from calgraph.sensors import PointCloud
from calgraph.simulation import load_truth

Run = Callable[..., Result]

TINY = ("--scanner-resolution=5", "--duration=1", "--clutter=0")


@pytest.fixture(scope="module")
def help_text() -> str:
    result = CliRunner(env={"COLUMNS": "80", "TERM": "dumb"}).invoke(app, ["simulate", "network", "--help"])
    return result.output


def test_the_help_shows_every_option(help_text: str) -> None:
    assert [knob.option for knob in _MODEL_OPTIONS.values() if knob.option not in help_text] == []


def test_every_option_is_described() -> None:
    assert [knob.option for knob in _MODEL_OPTIONS.values() if not knob.description] == []


def test_the_recording_and_what_belongs_to_it_are_written(run: Run, tmp_path: Path) -> None:
    result = run("simulate", "network", "-o", tmp_path / "out", *TINY)
    assert result.exit_code == 0, result.output
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["recording", "rig.yaml", "scenario.yaml", "truth.yaml"]


def test_a_layout_has_its_defaults(run: Run, tmp_path: Path) -> None:
    run("simulate", "network", "-o", tmp_path / "out", "--layout", "halls", *TINY)
    content = read_yaml(tmp_path / "out" / "scenario.yaml")
    assert (content["scanner"]["count"], content["scanner"]["rate"]) == (4, 25.0)


def test_options_go_before_the_layout(run: Run, tmp_path: Path) -> None:
    run("simulate", "network", "-o", tmp_path / "out", "--layout", "halls", "--scanner-rate=5", *TINY)
    assert read_yaml(tmp_path / "out" / "scenario.yaml")["scanner"]["rate"] == 5.0


def test_the_scenario_written_gives_the_same_network_again(run: Run, tmp_path: Path) -> None:
    run("simulate", "network", "-o", tmp_path / "a", "--seed", 3, "--layout=lab", *TINY)
    run("simulate", "network", "-o", tmp_path / "b", "--seed", 3, "--scenario", tmp_path / "a" / "scenario.yaml")
    a, b = ((tmp_path / name / "truth.yaml").read_text() for name in "ab")
    assert a == b


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["--layout", "attic"],
            "--layout: must be 'ring', 'office', 'semicircle', 'lab', 'halls', 'grid' or 'building'",
        ),
        (["--layout", "halls", "--scanner-count", "5"], "--scanner-count: halls have places for 4, got 5"),
        (["--scanner-count", "1"], "--scanner-count: must be 2 or greater, got 1"),
        (["--scanner-resolution", "400"], "--scanner-resolution: must be at most field_of_view, 270"),
        (["--background", "60"], "--background: must be below the duration, 60, got 60"),
        (["--root", "camera"], "--root: must be one of scanner_1 to scanner_6, got 'camera'"),
        (["--scanner-position-jitter", "1e5"], "scanner.position_jitter: 100000 m puts the scanner"),
    ],
)
def test_a_wrong_value_is_named_by_its_option(run: Run, tmp_path: Path, options: list[str], message: str) -> None:
    result = run("simulate", "network", "-o", tmp_path / "out", *options)
    assert (result.exit_code, (tmp_path / "out").exists()) == (2, False)
    assert f"calgraph: {message}" in result.stderr


def test_lidars_hang_in_a_hall(run: Run, tmp_path: Path) -> None:
    """Recording, rig and ground truth; options of 2-D scanners are refused by name."""
    given = ("--lidars", 2, "--lidar-model", "vlp16", "--people-count", 1, "--duration", 2, "--seed", 3)
    run("simulate", "network", "-o", tmp_path / "a", *given)
    rig, truth = read_yaml(tmp_path / "a" / "rig.yaml"), load_truth(tmp_path / "a" / "truth.yaml")
    assert rig["target"]["kind"] == "people"
    assert {name: one["kind"] for name, one in rig["sensors"].items()} == {
        "lidar_1": "lidar3d",
        "lidar_2": "lidar3d",
    }
    assert list(truth.T_root_sensor) == list(truth.clock_offsets) == ["lidar_1", "lidar_2"]
    with open_recordings([tmp_path / "a" / "recording"]) as recording:
        cloud = next(record.decode() for record in recording.records(["/lidar_2/points"]))
    assert isinstance(cloud, PointCloud)
    assert cloud.rings is not None
    assert cloud.times is not None
    assert set(cloud.rings) == set(range(16))
    assert 0.09 < cloud.times.max() < 0.11
    refused = run("simulate", "network", "-o", tmp_path / "b", "--lidars", 2, "--layout", "lab")
    assert refused.exit_code == 2
    assert "--layout: is of 2-D scanners" in refused.output


def test_scanners_hang_beside_lidars_at_stated_heights(run: Run, tmp_path: Path) -> None:
    """A mixed network; without LiDARs the option is refused, as --scanner-count is meant."""
    given = ("--scanners", 4, "--duration", 1)
    run("simulate", "network", "-o", tmp_path / "a", "--lidars", 1, *given)
    sensors = read_yaml(tmp_path / "a" / "rig.yaml")["sensors"]
    kinds = [(name, one["kind"]) for name, one in sensors.items()]
    assert kinds == [("lidar_1", "lidar3d"), *((f"scanner_{k}", "lidar2d") for k in range(1, 5))]
    heights = [one["height"] for name, one in sensors.items() if name != "lidar_1"]
    # With the error of a tape measure.
    assert heights == pytest.approx([0.3, 0.9, 1.4, 0.3], abs=0.08)
    assert heights[0] != heights[3]
    refused = run("simulate", "network", "-o", tmp_path / "b", *given)
    assert (refused.exit_code, (tmp_path / "b").exists()) == (2, False)
    assert "--scanner-count" in refused.stderr
