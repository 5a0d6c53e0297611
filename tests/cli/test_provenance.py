"""Provenance: which inputs a result was computed from, so that others can be told apart."""

import os
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest
from typer.testing import Result

from calgraph.calibration.result_files import hash_input, make_provenance
from calgraph.result import load_calibration

Run = Callable[..., Result]


def test_a_result_states_its_inputs(calibrated: tuple[Path, Result], simulated: Path) -> None:
    provenance = load_calibration(calibrated[0] / "calibration.yaml").provenance
    assert provenance is not None
    assert [(one.kind, Path(one.path).name, one.sha256) for one in provenance.inputs] == [
        ("rig", "rig.yaml", hash_input(simulated / "rig.yaml")),
        ("recording", "recording", hash_input(simulated / "recording")),
    ]
    assert provenance.messages is not None
    assert provenance.messages > 0


def test_the_report_states_them_too(calibrated: tuple[Path, Result], simulated: Path) -> None:
    assert hash_input(simulated / "recording") in (calibrated[0] / "report.html").read_text()


def test_inspect_prints_them(run: Run, calibrated: tuple[Path, Result]) -> None:
    shown = " ".join(run("inspect", calibrated[0]).stdout.split())
    assert "Computed by calgraph" in shown
    assert "Poses in the frame of lidar" in shown


@pytest.mark.parametrize("change", [b"b", b"aa"], ids=["content", "size"])
def test_another_file_has_another_hash(tmp_path: Path, change: bytes) -> None:
    for name, content in (("one", b"a"), ("same", b"a"), ("other", change)):
        (tmp_path / name).write_bytes(content)
    assert hash_input(tmp_path / "one") == hash_input(tmp_path / "same") != hash_input(tmp_path / "other")


def test_both_ends_of_a_large_file_count(tmp_path: Path) -> None:
    content = bytearray(3 * 2**20)
    for name, at in (("zero", None), ("first", 0), ("last", -1)):
        changed = bytearray(content)
        if at is not None:
            changed[at] = 1
        (tmp_path / name).write_bytes(changed)
    assert len({hash_input(tmp_path / name) for name in ("zero", "first", "last")}) == 3


def test_the_date_of_a_reproducible_build_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    assert make_provenance("", []).date == "1970-01-01T00:00:00+00:00"


def test_a_pipe_is_not_read_again_for_its_hash(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "rig.yaml")
    assert hash_input(tmp_path / "rig.yaml") == ""


@pytest.mark.parametrize("epoch", ["", "yesterday", "9" * 30])
def test_an_epoch_that_is_no_time_is_ignored(monkeypatch: pytest.MonkeyPatch, epoch: str) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", epoch)
    date = datetime.fromisoformat(make_provenance("", []).date)
    assert abs((datetime.now(UTC) - date).total_seconds()) < 60
