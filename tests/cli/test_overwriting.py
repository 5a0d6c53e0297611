"""No command replaces earlier results unless it is asked to, and other files in the folder stay."""

from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import Result

from calgraph.cli.common_options import RESULT_FILES, check_not_overwriting
from calgraph.errors import InputError

Run = Callable[..., Result]


@pytest.fixture
def earlier(tmp_path: Path) -> Path:
    """A folder with an earlier result."""
    folder = tmp_path / "result"
    folder.mkdir()
    (folder / "report.html").write_text("earlier")
    return folder


@pytest.mark.parametrize("command", ["calibrate", "solve", "check", "demo"])
def test_earlier_results_stay_and_the_error_says_what_to_do(
    run: Run, simulated: Path, earlier: Path, command: str
) -> None:
    rig, recording = simulated / "rig.yaml", simulated / "recording"
    (earlier / "rig.yaml").write_text("earlier")
    arguments: dict[str, list[object]] = {
        "calibrate": [rig, recording],
        "solve": [simulated / "problem.npz"],
        "check": [rig, recording, "--against", simulated / "truth.yaml"],
        "demo": [],
    }
    result = run(command, *arguments[command], "-o", earlier)
    assert result.exit_code == 2
    assert f"{earlier}: contains earlier results" in result.stderr
    assert "choose another OUT, or give --force to replace them" in result.stderr
    assert (earlier / "report.html").read_text() == "earlier"


@pytest.mark.slow
def test_with_force_they_are_replaced_and_other_files_stay(run: Run, simulated: Path, earlier: Path) -> None:
    (earlier / "notes.txt").write_text("mine")
    result = run("calibrate", simulated / "rig.yaml", simulated / "recording", "-o", earlier, "--force")
    assert result.exit_code == 0
    assert (earlier / "notes.txt").read_text() == "mine"
    assert {file.name for file in earlier.iterdir()} == {*RESULT_FILES, "notes.txt"}
    assert (earlier / "report.html").stat().st_size > 10_000


def test_a_dump_is_not_replaced_either(run: Run, simulated: Path, tmp_path: Path) -> None:
    (tmp_path / "problem.npz").write_text("earlier")
    files = [simulated / "rig.yaml", simulated / "recording"]
    result = run("calibrate", *files, "-o", tmp_path / "result", "--dump", tmp_path / "problem.npz")
    assert (result.exit_code, (tmp_path / "result").exists()) == (2, False)
    assert "contains earlier results (problem.npz)" in result.stderr


def test_a_folder_with_other_files_is_no_obstacle(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    check_not_overwriting(tmp_path, RESULT_FILES, force=False)
    (tmp_path / "captures.csv").touch()
    with pytest.raises(InputError, match=r"\(captures\.csv\)"):
        check_not_overwriting(tmp_path, RESULT_FILES, force=False)
    check_not_overwriting(tmp_path, RESULT_FILES, force=True)
