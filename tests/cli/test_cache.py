"""The cache of detections on the command line: found, shown, cleared, moved, switched off, and not writable."""

from collections.abc import Callable
from pathlib import Path
from shutil import copytree

import pytest
from typer.testing import Result

from calgraph.result import load_calibration
from written_results import read_without_provenance

pytestmark = pytest.mark.slow

Run = Callable[..., Result]
SENSORS = ("camera", "laser_front", "lidar")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache."""
    monkeypatch.setenv("CALGRAPH_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="module")
def first(run: Run, simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with ``cache``, and with ``result`` of the run that filled it; not to be changed."""
    folder = tmp_path_factory.mktemp("first")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CALGRAPH_CACHE", str(folder / "cache"))
        result = run("calibrate", simulated / "rig.yaml", simulated / "recording", "-o", folder / "result")
    assert result.exit_code == 0, result.output
    return folder


@pytest.fixture
def filled(first: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The cache after a run."""
    monkeypatch.setenv("CALGRAPH_CACHE", str(first / "cache"))
    return first / "cache"


def cached(folder: Path) -> tuple[str, ...]:
    provenance = load_calibration(folder / "calibration.yaml").provenance
    assert provenance is not None
    return provenance.cached


@pytest.mark.usefixtures("filled")
def test_a_second_calibration_has_the_same_files_and_says_where_detections_are_from(
    run: Run, simulated: Path, first: Path, calibrated: tuple[Path, Result], tmp_path: Path
) -> None:
    result = run("calibrate", simulated / "rig.yaml", simulated / "recording", "-o", tmp_path / "again", "-v")
    assert "detections of camera, lidar, laser_front: from the cache" in result.stderr
    folders = [calibrated[0], first / "result", tmp_path / "again"]
    for name in ("calibration.yaml", "budget.csv", "captures.csv", "report.html", "residuals.csv", "scene.npz"):
        assert len({read_without_provenance(folder / name) for folder in folders}) == 1, name
    assert [cached(folder) for folder in folders] == [(), (), SENSORS]
    assert "detections of camera, laser_front, lidar" in (tmp_path / "again" / "report.html").read_text("utf-8")
    shown = run("inspect", tmp_path / "again").stdout
    assert "detections of camera, laser_front, lidar were taken from the cache" in shown


@pytest.mark.usefixtures("filled")
@pytest.mark.parametrize("command", ["check", "verify"])
def test_other_commands_share_it(run: Run, simulated: Path, first: Path, command: str) -> None:
    against = ["--against", first / "result" / "calibration.yaml"]
    options = against if command == "check" else ["--rounds", "20"]
    result = run(command, simulated / "rig.yaml", simulated / "recording", *options, "-v")
    assert "detections of camera, lidar, laser_front: from the cache" in result.stderr


def test_it_is_shown(run: Run, filled: Path) -> None:
    entries = list(filled.iterdir())
    size = sum(entry.stat().st_size for entry in entries)
    assert run("cache").stdout == f"{filled}\n{len(entries)} entries, {size / 1e6:.1f} MB of at most 2000 MB\n"


def test_it_is_cleared(run: Run, first: Path, cache: Path) -> None:
    copytree(first / "cache", cache)
    assert run("cache", "--clear").stdout == f"{cache}\n0 entries, 0.0 MB of at most 2000 MB\n"
    assert list(cache.iterdir()) == []


def test_the_environment_limits_its_size(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CALGRAPH_CACHE", "cache")
    monkeypatch.setenv("CALGRAPH_CACHE_SIZE", "1.5GB")
    assert "at most 1500 MB" in run("cache").stdout
    monkeypatch.setenv("CALGRAPH_CACHE_SIZE", "much")
    result = run("cache")
    assert result.exit_code == 2
    assert "CALGRAPH_CACHE_SIZE: must be a size such as 500 MB or 5 GB, got 'much'" in result.stderr


def test_it_may_be_off(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CALGRAPH_CACHE", "off")
    assert run("cache").stdout == "The cache is off (CALGRAPH_CACHE).\n"


def test_without_a_home_there_is_none(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("CALGRAPH_CACHE")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", fail)
    assert run("cache").exit_code == 0


def test_a_folder_that_cannot_be_written_to_is_one_line(
    run: Run, simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("CALGRAPH_CACHE", str(tmp_path / "file" / "cache"))
    result = run("calibrate", simulated / "rig.yaml", simulated / "recording", "-o", tmp_path / "result")
    assert result.exit_code == 0
    without = run("calibrate", simulated / "rig.yaml", simulated / "recording", "-o", tmp_path / "b", "--no-cache")
    assert without.stderr == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"calgraph: the cache is not used: {tmp_path / 'file' / 'cache'}: cannot be written")
    assert line.endswith("set CALGRAPH_CACHE to another folder, or to off")
