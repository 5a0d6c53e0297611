"""residuals.csv: a row for every residual of the joint solution, in the unit of its sensor."""

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from calgraph.result import (
    BeamView,
    BoardView,
    Calibration,
    CaptureRow,
    DriveView,
    Pictures,
    save_captures,
    save_residuals,
)


@pytest.fixture
def rows(calibration: Calibration, tmp_path: Path) -> list[dict[str, str]]:
    pictures = Pictures(
        board_views=(
            BoardView(3, "camera", True, np.array([[100.0, 200.0]]), np.array([[0.3, -0.4]])),
            BoardView(3, "lidar", True, np.array([[1.0, 2.0, 3.0]]), np.array([-0.0125])),
            BoardView(4, "lidar", False, np.array([[1.0, 2.0, 3.0]])),
        ),
        beam_views=(BeamView("laser", np.array([7.25]), np.array([[4.0, -1.5]]), np.array([0.021])),),
        drive_views=(
            DriveView(
                "rear", 0, np.array([3.5]), np.array([[1.0, -2.0, 0.5]], np.float32), np.zeros((1, 3), np.float32),
                np.array([-0.004]), np.array([True]),
            ),
        ),
    )  # fmt: skip
    captures = (CaptureRow(3, 10.0, 12.0, "camera", True, ""),)
    evidence = dataclasses.replace(calibration.evidence, captures=captures)
    save_residuals(dataclasses.replace(calibration, pictures=pictures, evidence=evidence), tmp_path / "r.csv")
    with (tmp_path / "r.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_views_that_were_not_used_have_no_rows(rows: list[dict[str, str]]) -> None:
    assert [row["sensor"] for row in rows] == ["camera", "lidar", "laser", "rear"]


def test_a_corner_has_its_reprojection_error_and_its_components(rows: list[dict[str, str]]) -> None:
    corner = rows[0]
    assert (corner["capture"], float(corner["time"]), corner["unit"]) == ("3", 11.0, "px")
    assert [float(corner[name]) for name in ("x", "y")] == [100, 200]
    assert [float(corner[f"residual{of}"]) for of in ("", "_x", "_y")] == [0.5, 0.3, -0.4]


def test_a_point_on_the_board_has_its_signed_distance(rows: list[dict[str, str]]) -> None:
    point = rows[1]
    assert point["unit"] == "m"
    assert [float(point[name]) for name in ("x", "y", "z", "residual")] == [1, 2, 3, -0.0125]
    assert (point["residual_x"], point["residual_y"]) == ("", "")


def test_a_beam_of_a_network_has_its_time_and_no_capture(rows: list[dict[str, str]]) -> None:
    beam = rows[2]
    assert (beam["capture"], float(beam["time"]), beam["z"]) == ("", 7.25, "")
    assert [float(beam[name]) for name in ("x", "y", "residual")] == [4, -1.5, 0.021]


def test_a_point_of_a_drive_has_its_distance_from_the_surface(rows: list[dict[str, str]]) -> None:
    point = rows[3]
    assert (point["capture"], float(point["time"]), point["unit"]) == ("", 3.5, "m")
    assert [float(point[name]) for name in ("x", "y", "z", "residual")] == [1, -2, 0.5, -0.004]


@pytest.mark.parametrize("start", ["=", "+", "-", "@", "\t"])
def test_no_cell_is_a_formula_for_spreadsheets(calibration: Calibration, tmp_path: Path, start: str) -> None:
    name = start + "1+1"
    rows = (CaptureRow(3, 10.0, 12.0, name, False, name),)
    views = (BoardView(3, name, True, np.array([[1.0, 2.0, 3.0]]), np.array([-0.0125])),)
    beams = (BeamView(name, np.array([7.25]), np.array([[4.0, -1.5]]), np.array([0.021])),)
    changed = dataclasses.replace(
        calibration,
        evidence=dataclasses.replace(calibration.evidence, captures=rows),
        pictures=Pictures(board_views=views, beam_views=beams),
    )
    save_captures(changed, tmp_path / "captures.csv")
    save_residuals(changed, tmp_path / "residuals.csv")
    texts = []
    for file in ("captures.csv", "residuals.csv"):
        with (tmp_path / file).open(encoding="utf-8", newline="") as stream:
            texts += [row[key] for row in csv.DictReader(stream) for key in ("sensor", "reason") if key in row]
    assert texts == ["'" + name] * 4
