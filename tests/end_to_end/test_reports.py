"""The report of the recording that `calgraph demo` makes: small, quick, and with all of its pictures."""

import time
from pathlib import Path

import pytest

from calgraph.config import Rig
from calgraph.recording import resolve_intrinsics
from calgraph.report import write_report
from calgraph.result import Calibration
from calgraph.simulation import RigScenario
from simulated_rigs import calibrate, simulate_scenario

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def found() -> tuple[Calibration, Rig]:
    rig, recording, _ = simulate_scenario(RigScenario())
    return calibrate(rig, recording), resolve_intrinsics(rig, recording)


def test_it_is_small_and_quick(found: tuple[Calibration, Rig], tmp_path: Path) -> None:
    """Time of the processor, as others may use it too."""
    began = time.process_time()
    write_report(*found, tmp_path / "report.html")
    assert time.process_time() - began < 2.5
    assert (tmp_path / "report.html").stat().st_size < 12e6


def test_it_shows_every_capture_with_images_and_scans(found: tuple[Calibration, Rig], tmp_path: Path) -> None:
    write_report(*found, tmp_path / "report.html")
    html = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert html.count('<article class="capture">') == len({row.capture for row in found[0].evidence.captures})
    for section in ("images", "cloud", "coverage"):
        assert f'id="{section}"' in html
    assert "is not part of this result" not in html
