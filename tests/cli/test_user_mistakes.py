"""Mistakes of users, each with its exit code and a message that names its cause and what to do: none is silent."""

import copy
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML
from typer.testing import Result

from calgraph.io.yaml_reading import read_yaml
from user_mistakes import COMMANDS, RESULTS, RIG_KEYS, RIG_TEXTS, USAGE

pytestmark = pytest.mark.slow

Run = Callable[..., Result]


@pytest.fixture(scope="module")
def places(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mapping[str, Path]]:
    """What command lines name: a rig, its recording, and files that are none."""
    tmp = tmp_path_factory.mktemp("mistakes")
    mcap = next((simulated / "recording").glob("*.mcap"))
    shutil.copy(simulated / "rig.yaml", tmp / "rig.yaml")
    (tmp / "empty").mkdir()
    (tmp / "earlier").mkdir()
    (tmp / "loop").symlink_to("loop")
    (tmp / "earlier/report.html").touch()
    (tmp / "zero.mcap").touch()
    (tmp / "text.mcap").write_text("hello")
    (tmp / "cut.mcap").write_bytes(mcap.read_bytes()[:5000])
    (tmp / "board.pdf").write_bytes(b"%PDF-1.4\xff\xfe")
    yield {
        "tmp": tmp,
        "rig": tmp / "rig.yaml",
        "rec": simulated / "recording",
        "robot": simulated,
        "mcap": mcap,
        "out": tmp / "result",
        "truth": simulated / "truth.yaml",
    }
    assert not (tmp / "result").exists()


@pytest.fixture(scope="module")
def _cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Detections that a mistake does not change are those of an earlier test, which saves their time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CALGRAPH_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def edited(rig: Path, path: str, value: Any, to: Path) -> Path:
    """The rig with one key set to a value, or left out for None."""
    content = copy.deepcopy(read_yaml(rig))
    *above, key = (int(one) if one.isdigit() else one for one in path.split("."))
    place: Any = content
    for one in above:
        place = place[one]
    place[key] = value
    if value is None:
        del place[key]
    with to.open("w", encoding="utf-8") as file:
        YAML().dump(content, file)
    return to


def assert_one_line(result: Result, message: str) -> None:
    """Bad input: exit code 2, and one line on stderr alone."""
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    assert (result.exit_code, result.stdout) == (2, "")
    first, *others = result.stderr.splitlines()
    assert re.match(f"calgraph: .*{message}", first), result.stderr
    # One value may be wrong in several ways, each on its line.
    assert all(line.startswith("calgraph: ") for line in others)
    assert len(others) <= 1


@pytest.mark.parametrize("mistake", RIG_KEYS)
def test_in_a_key_of_rig_yaml(run: Run, places: Mapping[str, Path], tmp_path: Path, mistake: str) -> None:
    path, value, message = RIG_KEYS[mistake]
    rig = edited(places["rig"], path, value, tmp_path / "rig.yaml")
    assert_one_line(run("calibrate", rig, places["rec"], "-o", tmp_path / "result"), message)
    assert not (tmp_path / "result").exists()


@pytest.mark.parametrize("mistake", RIG_TEXTS)
def test_in_the_text_of_rig_yaml(run: Run, places: Mapping[str, Path], tmp_path: Path, mistake: str) -> None:
    old, new, message = RIG_TEXTS[mistake]
    rig = tmp_path / "rig.yaml"
    text = places["rig"].read_text(encoding="utf-8").replace(old, new, 1)
    rig.write_bytes(text.encode("utf-8", "surrogateescape"))
    assert_one_line(run("calibrate", rig, places["rec"], "-o", tmp_path / "result"), message)


@pytest.mark.parametrize("mistake", COMMANDS)
def test_in_a_command_line(run: Run, places: Mapping[str, Path], mistake: str) -> None:
    line, message = COMMANDS[mistake]
    assert_one_line(run(*line.format(**places).split()), message)


@pytest.mark.parametrize("mistake", USAGE)
def test_in_the_usage(run: Run, places: Mapping[str, Path], mistake: str) -> None:
    line, message = USAGE[mistake]
    result = run(*line.format(**places).split())
    assert_one_line(result, message)
    assert re.search(r"; see \S+( calibrate| export)? --help$", result.stderr)


@pytest.mark.usefixtures("_cache")
@pytest.mark.parametrize("mistake", RESULTS)
def test_in_what_rig_yaml_states(run: Run, places: Mapping[str, Path], tmp_path: Path, mistake: str) -> None:
    path, value, code, message = RESULTS[mistake]
    rig = edited(places["rig"], path, value, tmp_path / "rig.yaml")
    result = run("calibrate", rig, places["rec"], "-o", tmp_path / "result", "--folds", 0)
    assert result.exit_code == code, result.output
    assert re.search(message, result.output), result.output


def test_the_rig_without_mistakes_has_none_of_these_messages(
    run: Run, places: Mapping[str, Path], tmp_path: Path
) -> None:
    result = run("calibrate", places["rig"], places["rec"], "-o", tmp_path / "result", "--folds", 0)
    assert (result.exit_code, result.stderr) == (0, "")
    assert [name for name, (*_, message) in RESULTS.items() if re.search(message, result.stdout)] == []


def test_a_forgotten_background_is_found_in_the_recording(
    run: Run, places: Mapping[str, Path], tmp_path: Path
) -> None:
    rig = edited(places["rig"], "capture.background", None, tmp_path / "rig.yaml")
    assert run("calibrate", rig, places["rec"], "-o", tmp_path / "result", "--folds", 0).exit_code == 0
    assert "background" not in read_yaml(tmp_path / "result/rig.resolved.yaml")["capture"]  # it is not stated
    remarks = read_yaml(tmp_path / "result/calibration.yaml")["quality"]["remarks"]
    (end,) = [
        float(one) for remark in remarks for one in re.findall(r"no capture\.background: 0\.0 to (\S+) s", remark)
    ]
    assert 1.5 < end < 2.86  # when the first capture starts


def test_there_are_sixty_at_least() -> None:
    names = [name for table in (RIG_KEYS, RIG_TEXTS, COMMANDS, USAGE, RESULTS) for name in table]
    assert len(set(names)) == len(names) >= 60
