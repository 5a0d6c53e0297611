"""Coverage of fields of view, and the description of gaps."""

import dataclasses

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.geometry import Array
from calgraph.report.coverage_view import compute_coverage, render_coverage
from calgraph.report.vocabulary import BOARD_VOCABULARY
from calgraph.result import BoardView, Calibration


def with_views(calibration: Calibration, sensor: str, *views_of_board: Array) -> Calibration:
    views = tuple(BoardView(k, sensor, True, one) for k, one in enumerate(views_of_board))
    return dataclasses.replace(
        calibration, pictures=dataclasses.replace(calibration.pictures, board_views=views, board_outlines=())
    )


def around(low: float, high: float, distance: float, height: float = 0.0) -> Array:
    """(N, 3) points at all azimuths between two, degrees."""
    azimuth = np.radians(np.arange(low, high, 0.5) + 0.25)
    return np.column_stack([distance * np.cos(azimuth), distance * np.sin(azimuth), np.full(len(azimuth), height)])


def remarks(calibration: Calibration, rig: Rig, sensor: str) -> str:
    found = compute_coverage(calibration, rig, calibration[sensor])
    assert found is not None
    return " ".join(found.remarks)


def test_an_image_names_its_parts_without_corners(calibration: Calibration, rig: Rig) -> None:
    """1280 by 720: all thirds but those at the bottom left and the middle right."""
    grid = [(x, y) for x in (200, 640, 1100) for y in (100, 360, 650) if (x, y) not in {(200, 650), (1100, 360)}]
    covered = with_views(calibration, "camera", np.array(grid, dtype=float))
    assert "Missing: no corners in the centre right and bottom left of the image." in remarks(
        covered, rig, "camera"
    )


def test_a_fully_covered_image_is_reported(calibration: Calibration, rig: Rig, rng: np.random.Generator) -> None:
    full = with_views(calibration, "camera", rng.uniform([0, 0], [1279, 719], (500, 2)))
    assert "There were corners in all parts of the image." in remarks(full, rig, "camera")


def test_cells_count_captures_and_not_corners(calibration: Calibration, rig: Rig) -> None:
    one = np.array([[10.0, 10.0], [11.0, 11.0], [12.0, 10.0]])
    found = compute_coverage(
        with_views(calibration, "camera", one, one, one[:1] + 600), rig, calibration["camera"]
    )
    assert found is not None
    assert found.counts[0, 0] == 2
    assert found.counts.sum() == 3


def test_distances_and_tilts_are_those_of_the_boards(pictured: Calibration, rig: Rig) -> None:
    assert "m away, tilted" in remarks(pictured, rig, "camera")


def test_missing_sectors_are_named(calibration: Calibration, rig: Rig) -> None:
    """Three quarters of a turn are visible, from the background of other captures."""
    covered = with_views(calibration, "laser", around(-60, 60, 2.0), around(-135, 135, 1.0)[:1])
    whole = dataclasses.replace(covered, pictures=dataclasses.replace(covered.pictures, snapshots=()))
    text = remarks(whole, rig, "laser")
    assert text == "The board was in all directions of the field of view. The board was 1.0–2.0 m away."


def test_sectors_behind_are_merged(pictured: Calibration, rig: Rig) -> None:
    """A LiDAR with a full field of view, and boards in front only."""
    ahead = with_views(pictured, "lidar", around(-60, 60, 2.0))
    taken = tuple(
        dataclasses.replace(s, points=around(-180, 180, 5.0).astype(np.float32))
        for s in pictured.pictures.snapshots
    )
    text = remarks(
        dataclasses.replace(ahead, pictures=dataclasses.replace(ahead.pictures, snapshots=taken)), rig, "lidar"
    )
    assert "The board was in 33 % of the directions of the field of view. Missing: 60° to −60° (behind)." in text


def test_left_is_left_and_up_is_up(calibration: Calibration, rig: Rig) -> None:
    """A board at 90° to the left and above; the field reaches below."""
    covered = with_views(calibration, "lidar", around(88, 92, 2.0, 1.0), around(-2, 2, 2.0, -1.0))
    found = compute_coverage(covered, rig, calibration["lidar"])
    assert found is not None
    rows, columns = np.nonzero(found.counts)
    left = columns < found.counts.shape[1] * 0.3
    assert left.any()
    assert (rows[left] < 3).all()
    assert (rows[~left] > 8).all()


def test_coverage_of_a_network_is_of_its_tracks(network: Calibration, network_rig: Rig) -> None:
    """From the hall, the walk along x = 2 m leads from ahead to 68° on the left."""
    text = remarks(network, network_rig, "hall")
    assert "Missing:" in text
    assert "People walked 2.0–5.5 m away." in text


def test_non_finite_points_are_not_counted(calibration: Calibration, rig: Rig) -> None:
    gaps = np.where(np.arange(240)[:, None] % 2, around(-60, 60, 2.0), np.nan)
    covered = with_views(calibration, "laser", gaps, np.full((3, 3), np.inf), np.empty((0, 3)))
    found = compute_coverage(covered, rig, calibration["laser"])
    assert found is not None
    assert found.counts.max() == 1
    assert "2.0–2.0 m away" in " ".join(found.remarks)


def test_a_result_without_detections_is_reported(bare: Calibration, rig: Rig) -> None:
    assert "contains no detections" in render_coverage(bare, rig, BOARD_VOCABULARY)


@pytest.mark.parametrize("name", ["lidar", "camera", "laser"])
def test_the_figure_has_a_cell_for_each_count(pictured: Calibration, rig: Rig, name: str) -> None:
    found = compute_coverage(pictured, rig, pictured[name])
    assert found is not None
    html = render_coverage(pictured, rig, BOARD_VOCABULARY)
    drawing = html[html.index(f"<h3>{name}</h3>") :].split("</svg>")[0]
    assert drawing.count('class="cell"') == np.count_nonzero(found.counts)
