"""A small simulated recording, made and calibrated once."""

from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from calgraph.cli.app import app

Run = Callable[..., Result]

_SMALL = (
    "--camera-width 480 --camera-height 360 --camera-rate 4 --camera-texels-per-mm 1 --laser-count 1 "
    "--laser-rate 10 --laser-resolution 0.5 --spinning-count 0 --multibeam-count 1 --multibeam-rate 5 "
    "--multibeam-resolution 0.4 --bearings -30,0,30 --radii 1.8 --samples 3 --background 2.5 --hold-time 0.8 "
    "--move-time 0.4 --clutter 2"
)
_WITHOUT_BOOTSTRAP = """
settings:
  diagnostics:
    rig:
      max_bootstrap_captures: 1 # from 15 captures on, as by default, calibrations do without it and its time, too
"""


def invoke(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="session")
def run() -> Run:
    """Runs a command in this process."""
    return invoke


@pytest.fixture(scope="session")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that ``simulate rig`` wrote; not to be changed."""
    out = tmp_path_factory.mktemp("simulated") / "robot"
    result = invoke("simulate", "rig", "-o", out, *_SMALL.split())
    assert result.exit_code == 0, result.output
    with (out / "rig.yaml").open("a", encoding="utf-8") as rig:
        rig.write(_WITHOUT_BOOTSTRAP)
    return out


@pytest.fixture(scope="session")
def calibrated(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """The folder that ``calibrate --json`` wrote, and what it printed; not to be changed."""
    out = tmp_path_factory.mktemp("calibrated") / "result"
    result = invoke("calibrate", simulated / "rig.yaml", simulated / "recording", "-o", out, "--json")
    assert result.exit_code == 0, result.output
    return out, result
