"""What check prints: marks with their meaning, displacements, and what to do."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calgraph.cli.check import _print, _print_next_step
from calgraph.config import Tolerance
from calgraph.verdict.comparison import AxisComparison, ExtrinsicsComparison, SensorComparison

SURE = AxisComparison("x", -1e-5, 0.001, "pass", 0.005, 0.001)
UNSURE = AxisComparison("x", -1e-5, 0.009, "warn", 0.005, 0.009)
SIGNIFICANT = AxisComparison("x", 0.006, 0.001, "warn", 0.005, 0.001)
OFF = AxisComparison("x", 0.03, 0.001, "fail", 0.005, 0.001)


def audit(axis: AxisComparison) -> ExtrinsicsComparison:
    """Of a sensor with one axis that differs from the others."""
    camera = SensorComparison("camera", axis.outcome, "", 0.0, (axis, *[SURE] * 5))
    return ExtrinsicsComparison("lidar", (camera,), None)


def printed(comparison: ExtrinsicsComparison, capsys: pytest.CaptureFixture[str]) -> list[str]:
    _print(comparison, Path("robot.urdf"), "lidar", Tolerance())
    return capsys.readouterr().out.splitlines()


PASS = "✓ within the tolerance of 10 mm and 0.3°"
UNDECIDED = "? not decided: σ is too large for this tolerance"


@pytest.mark.parametrize(
    ("axis", "cell", "legend"),
    [
        (SURE, "+0.0", PASS),
        (UNSURE, "+0.0?", f"{PASS}; {UNDECIDED}; ! a warning: see below"),
        (SIGNIFICANT, "+6.0!", f"{PASS}; ! a warning: see below"),
        (OFF, "+30.0✕", f"{PASS}; ✕ off by more than the tolerance"),
    ],
)
def test_the_marks_of_the_table_have_a_legend(
    axis: AxisComparison, cell: str, legend: str, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = printed(audit(axis), capsys)
    assert lines[2].split()[:2] == ["camera", cell]
    assert lines[5] == legend


def test_displacements_that_round_to_zero_have_no_minus(capsys: pytest.CaptureFixture[str]) -> None:
    lines = printed(audit(SURE), capsys)
    assert lines[2].split() == ["camera", "+0.0", "+0.0", "+0.0", "+0.00", "+0.00", "+0.00", "✓"]


def test_axes_that_were_not_measured_are_empty(capsys: pytest.CaptureFixture[str]) -> None:
    lines = printed(audit(replace(SURE, stddev=np.nan)), capsys)
    assert len(lines[2].split()) == 7


@pytest.mark.parametrize(("out", "source"), [(None, "which --out writes"), (Path("new"), "from new")])
def test_the_next_step_of_a_failed_sensor_is_its_mount_or_its_new_pose(
    out: Path | None, source: str, capsys: pytest.CaptureFixture[str]
) -> None:
    _print_next_step(audit(OFF), out)
    text = capsys.readouterr().out
    assert text.startswith("To do: mount camera as before, or take the new pose")
    assert text.endswith(f"{source}\n")


def test_the_next_step_of_an_undecided_sensor_is_the_remedy(capsys: pytest.CaptureFixture[str]) -> None:
    _print_next_step(replace(audit(UNSURE), remedy="at least 40 captures"), None)
    assert capsys.readouterr().out == "To decide: at least 40 captures\n"


def test_there_is_no_next_step_of_what_passes(capsys: pytest.CaptureFixture[str]) -> None:
    _print_next_step(audit(SURE), None)
    assert capsys.readouterr().out == ""
