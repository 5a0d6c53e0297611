"""calgraph simulate rig: its knobs, its files, and what it says of wrong values."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel
from typer.testing import CliRunner, Result

from calgraph.cli.app import app
from calgraph.cli.simulate import _MODEL_OPTIONS
from calgraph.config import load_rig
from calgraph.io.yaml_reading import read_yaml
from calgraph.simulation import RigScenario, load_truth

Run = Callable[..., Result]
Names = list[str]

TINY = (
    "--camera-count=0", "--spinning-count=0", "--laser-count=2", "--laser-rate=5", "--laser-resolution=5",
    "--bearings=0", "--radii=2", "--samples=1", "--background=0.5", "--hold-time=0.5", "--clutter=0",
)  # fmt: skip


def leaves(model: type[BaseModel], path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    for name, field in model.model_fields.items():
        if name == "uncertainty":
            continue
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from leaves(field.annotation, (*path, name))
        elif (*path, name) != ("board", "kind"):
            yield (*path, name)


@pytest.fixture(scope="module")
def help_text() -> str:
    result = CliRunner(env={"COLUMNS": "80", "TERM": "dumb"}).invoke(app, ["simulate", "rig", "--help"])
    return result.output


def test_every_field_of_the_scenario_has_an_option() -> None:
    assert [knob.path for knob in _MODEL_OPTIONS.values()] == list(leaves(RigScenario))


def test_the_help_shows_every_option(help_text: str) -> None:
    assert [knob.option for knob in _MODEL_OPTIONS.values() if knob.option not in help_text] == []


def test_every_option_is_described() -> None:
    assert [knob.option for knob in _MODEL_OPTIONS.values() if not knob.description] == []


def test_the_help_fits_80_columns(help_text: str) -> None:
    assert max(map(len, help_text.splitlines())) <= 80


def test_the_help_shows_defaults(help_text: str) -> None:
    assert re.search(r"Images per second\.\W+\[default:", help_text)


def test_the_recording_and_what_belongs_to_it_are_written(simulated: Path) -> None:
    names = sorted(path.name for path in simulated.iterdir())
    assert names == ["recording", "rig.yaml", "scenario.yaml", "truth.yaml"]


def test_options_reach_the_robot(simulated: Path) -> None:
    assert list(load_rig(simulated / "rig.yaml").sensors) == ["camera", "lidar", "laser_front"]


def test_the_scenario_written_gives_the_same_robot_again(run: Run, tmp_path: Path) -> None:
    run("simulate", "rig", "-o", tmp_path / "a", "--seed", 3, *TINY)
    run("simulate", "rig", "-o", tmp_path / "b", "--seed", 3, "--scenario", tmp_path / "a" / "scenario.yaml")
    a, b = ((tmp_path / name / "truth.yaml").read_text() for name in "ab")
    assert a == b


def test_options_go_before_the_scenario_file(run: Run, tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text("laser: {count: 4}\nboard: {size: [2.0, 1.0]}")
    options = ["--scenario", tmp_path / "s.yaml", *TINY, "--no-trigger"]
    assert run("simulate", "rig", "-o", tmp_path / "out", *options).exit_code == 0
    content = read_yaml(tmp_path / "out" / "scenario.yaml")
    chosen = (content["laser"]["count"], content["board"]["size"], content["trigger"])
    assert chosen == (2, [2.0, 1.0], False)


def test_a_pattern_takes_the_place_of_the_tags(run: Run, tmp_path: Path) -> None:
    pattern = "{kind: checkerboard, columns: 7, rows: 5, square: 0.1}"
    result = run("simulate", "rig", "-o", tmp_path / "out", *TINY, "--board-pattern", pattern)
    assert result.exit_code == 0, result.output
    [board] = load_rig(tmp_path / "out" / "rig.yaml").boards
    assert (board.tags, board.pattern is not None) == ((), True)


def test_another_seed_gives_another_robot(run: Run, tmp_path: Path) -> None:
    for seed in (1, 2):
        run("simulate", "rig", "-o", tmp_path / str(seed), "--seed", seed, *TINY)
    a, b = (load_truth(tmp_path / name / "truth.yaml").T_root_sensor for name in "12")
    assert (a["laser_left"] != b["laser_left"]).any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--camera-rate", "-1"], "--camera-rate: must be greater than 0, got -1"),
        (["--laser-rate", "abc"], "--laser-rate: must be a number, got 'abc'"),
        (["--samples", "1.5"], "--samples: must be a whole number, got 1.5"),
        (["--bearings", "1,x"], "--bearings[1]: must be a number, got 'x'"),
        (["--bearings", ""], "--bearings: must not be empty, got []"),
        (["--mount-rotation", "nan"], "--mount-rotation: must be a finite number, got nan"),
        (["--camera-model", "fish"], "--camera-model: must be 'pinhole' or 'fisheye', got 'fish'"),
        (["--board-size", "1,2,3"], "--board-size: must have 2 elements, got [1, 2, 3]"),
        (["--board-tags", "[{id:"], "--board-tags: is not valid YAML, got '[{id:'"),
        (["--board-tags", "[{id: 0, sise: 1}]"], "unknown key --board-tags[0].sise; did you mean 'size'?"),
        (["--camera-field-of-view", "178"], "--camera-*: a pinhole's field_of_view must be below 175 degrees"),
        (
            ["--laser-count", "1", "--camera-count", "0", "--spinning-count", "0"],
            "options: a rig needs at least two",
        ),
    ],
)
def test_a_wrong_value_is_named_by_its_option(run: Run, tmp_path: Path, options: Names, message: str) -> None:
    result = run("simulate", "rig", "-o", tmp_path / "out", *options)
    assert result.exit_code == 2
    assert f"calgraph: {message}" in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_wrong_value_in_the_scenario_file_is_named_by_its_key(run: Run, tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text("camera: {rate: 0}")
    result = run("simulate", "rig", "-o", tmp_path / "out", "--scenario", tmp_path / "s.yaml")
    assert result.exit_code == 2
    assert result.stderr == f"calgraph: {tmp_path / 's.yaml'}: camera.rate: must be greater than 0, got 0\n"


def test_an_earlier_recording_is_not_overwritten(run: Run, simulated: Path) -> None:
    result = run("simulate", "rig", "-o", simulated, *TINY)
    assert result.exit_code == 2
    assert result.stderr == (
        f"calgraph: {simulated / 'recording'}: exists already; remove it or choose another OUT\n"
    )


@pytest.mark.parametrize(
    ("option", "value", "allowed"),
    [
        ("--camera-width", "1000000000", "20000 or less"),
        ("--multibeam-resolution", "1e-9", "0.01 or greater"),
        ("--radii", "1e300", "1e+06 or less"),
        ("--camera-count", "1000000", "1000 or less"),
    ],
)
def test_sizes_beyond_any_machine_are_named(
    run: Run, tmp_path: Path, option: str, value: str, allowed: str
) -> None:
    result = run("simulate", "rig", "-o", tmp_path / "out", option, value)
    assert result.exit_code == 2
    assert re.search(rf"calgraph: {option}.*must be {re.escape(allowed)}", result.stderr)
