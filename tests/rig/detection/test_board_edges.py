"""Edges of a board: at depth jumps to the background, and nowhere else."""

import numpy as np
import pytest

from calgraph.config import Board, RangeNoise
from calgraph.config.settings import DetectionSettings, ScannerDetectionSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array, Index
from calgraph.rig.detection.lidar2d import find_segments
from calgraph.rig.detection.line_plane_fit import find_board_edges, select_beams_with_margin
from calgraph.sensors import LaserScan

STEP = np.radians(0.5)
BEAMS = np.arange(40)
SETTINGS = ScannerDetectionSettings()
SHEET, WALL, HAND = 2.0, 5.0, 1.8


def directions_of(angles: Array) -> Array:
    return np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)


def angles_of(edges: Array) -> Array:
    """(M, 2) rad, those at the lower end of the board first."""
    angles = np.arctan2(edges[..., 1], edges[..., 0])
    return np.asarray(angles[np.argsort(angles[:, 0])])


def edges_of(ranges: Array, beams: Index = BEAMS, line: Index | None = None, parallax: float = 0.0) -> Array:
    """Edges of a board at the same distance in all directions, in steps of beams."""
    line = np.zeros(len(beams), dtype=np.intp) if line is None else line
    edges = find_board_edges(directions_of(STEP * beams), ranges - SHEET, line, 0.05, SETTINGS, parallax)
    return np.asarray(angles_of(edges) / STEP)


def scene(first: int = 10, last: int = 29, behind: float = WALL) -> Array:
    """Ranges of beams of which those from ``first`` to ``last`` end on the board."""
    return np.where((first <= BEAMS) & (last >= BEAMS), SHEET, behind)


def test_edges_lie_between_the_last_beam_on_the_board_and_the_first_one_past_it() -> None:
    np.testing.assert_allclose(edges_of(scene()), [[10, 9], [29, 30]], atol=1e-3)


def test_an_occluded_board_has_no_edges() -> None:
    ranges = scene()
    ranges[30:34] = HAND
    np.testing.assert_allclose(edges_of(ranges), [[10, 9]], atol=1e-3)


def test_the_end_of_the_field_of_view_is_no_edge() -> None:
    np.testing.assert_allclose(edges_of(scene(last=39)), [[10, 9]], atol=1e-3)


def test_a_board_close_to_a_wall_has_no_edges() -> None:
    assert len(edges_of(scene(behind=SHEET + 0.08))) == 0


def test_a_mixed_pixel_widens_the_edge_by_one_step() -> None:
    ranges = scene()
    ranges[30] = 3.4
    np.testing.assert_allclose(edges_of(ranges), [[10, 9], [29, 31]], atol=1e-3)


def test_a_missing_beam_at_the_edge_widens_it_by_one_step() -> None:
    there = np.delete(BEAMS, 30)
    np.testing.assert_allclose(edges_of(scene()[there], there), [[10, 9], [29, 31]], atol=1e-3)


def test_a_board_with_no_returns_around_it_has_edges() -> None:
    there = np.concatenate([BEAMS[:5], BEAMS[10:30], [200]])
    ranges = np.concatenate([np.full(5, WALL), np.full(20, SHEET), [WALL]])
    np.testing.assert_allclose(edges_of(ranges, there), [[10, 9], [29, 30]], atol=1e-3)


def test_missing_beams_within_the_board_are_no_edges() -> None:
    there = np.delete(BEAMS, np.arange(15, 21))
    np.testing.assert_allclose(edges_of(scene()[there], there), [[10, 9], [29, 30]], atol=1e-3)


def test_edges_do_not_span_scan_lines() -> None:
    line = np.where(BEAMS < 20, 0, 1)
    ranges = np.where(BEAMS < 20, SHEET, WALL)
    assert len(edges_of(ranges, line=line)) == 0


def edges_of_returns(ranges: Array, beams: Index) -> Array:
    """Edges as of drivers that publish several returns of a beam, with coordinates in single precision."""
    points = (ranges[:, None] * directions_of(STEP * beams)).astype(np.float32).astype(float)
    lengths = np.linalg.norm(points, axis=1)
    line = np.zeros(len(beams), dtype=np.intp)
    edges = find_board_edges(points / lengths[:, None], lengths - SHEET, line, 0.05, SETTINGS, 0.0)
    return np.asarray(angles_of(edges) / STEP)


@pytest.mark.parametrize("returns", [2, 3])
def test_several_returns_of_each_beam_do_not_move_edges(returns: int) -> None:
    # Returns of one beam that differ by the noise have directions that differ by their rounding.
    noise = np.random.default_rng(1).normal(0, 0.01, returns * len(BEAMS))
    edges = edges_of_returns(np.repeat(scene(), returns) + noise, np.repeat(BEAMS, returns))
    np.testing.assert_allclose(edges, [[10, 9], [29, 30]], atol=1e-3)


@pytest.mark.parametrize("returns", [(SHEET, WALL), (WALL, SHEET)], ids=["board first", "wall first"])
def test_a_beam_with_returns_from_board_and_wall_widens_the_edge_by_one_step(returns: tuple[float, float]) -> None:
    ranges = np.concatenate([scene()[:30], returns, scene()[31:]])
    edges = edges_of_returns(ranges, np.insert(BEAMS, 30, 30))
    np.testing.assert_allclose(edges, [[10, 9], [29, 31]], atol=1e-3)


def test_a_beam_with_returns_from_a_hand_and_the_wall_is_no_edge() -> None:
    ranges, beams = np.insert(scene(), 30, HAND), np.insert(BEAMS, 30, 30)
    np.testing.assert_allclose(edges_of_returns(ranges, beams), [[10, 9]], atol=1e-3)


def test_with_parallax_directions_of_the_background_do_not_count() -> None:
    angles = STEP * BEAMS + np.where(scene() == WALL, 0.6 * STEP, 0.0)
    edges = find_board_edges(
        directions_of(angles), scene() - SHEET, np.zeros(40, dtype=np.intp), 0.05, SETTINGS, parallax=0.03
    )
    np.testing.assert_allclose(angles_of(edges) / STEP, [[10, 9], [29, 30]], atol=1e-3)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_few_beams_have_no_edges(count: int) -> None:
    assert edges_of(np.full(count, SHEET), BEAMS[:count]).shape == (0, 2)


def test_selected_beams_are_those_near_the_board_and_two_on_each_side() -> None:
    np.testing.assert_array_equal(select_beams_with_margin(scene() == SHEET), np.arange(8, 32))


def test_edges_of_scans_lie_on_either_side_of_the_boards_ends_without_bias() -> None:
    """A board across the view; over many phases of the beams, the pairs are centred on its ends."""
    rng, step, half = np.random.default_rng(0), np.radians(0.25), 0.5
    off, widths = [], []
    for _ in range(60):
        angles = np.arange(-60, 60) * step * 2 + rng.uniform(-step, step)
        true = np.where(np.abs(2.0 * np.tan(angles)) < half, 2.0, 8.0) / np.cos(angles)
        scans = [LaserScan(0.0, "laser", angles, true + rng.normal(0, 0.012, len(angles))) for _ in range(3)]
        segments = find_segments(
            scans,
            [Board(size=(1.0, 0.8))],
            RangeNoise(range=0.012, angle=0.001),
            None,
            rng,
            settings=DetectionSettings(),
        )
        assert not isinstance(segments, Rejected)
        ends = 2.0 * segments[0].edges[..., 1] / segments[0].edges[..., 0]
        assert len(ends) == 2
        off.append(np.abs(ends.mean(axis=1)) - half)
        widths.append(np.abs(np.diff(ends, axis=1)[:, 0]))
    whitened = np.array(off) / (np.array(widths) / np.sqrt(12))
    assert abs(whitened.mean()) < 4 / np.sqrt(whitened.size)
    assert whitened.std() == pytest.approx(1.0, abs=0.2)
