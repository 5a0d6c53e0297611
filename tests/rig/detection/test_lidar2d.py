"""Boards in 2-D scans: by ray casting with a known answer, and in real scans of an office."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from calgraph.boards.detections import Segment
from calgraph.config import Board, RangeNoise
from calgraph.config.settings import DetectionSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array
from calgraph.rig.detection.background_learning import learn_scan_background
from calgraph.rig.detection.lidar2d import find_segments
from calgraph.sensors import LaserScan

NOISE = RangeNoise(range=0.015, angle=0.0005)
BOARD = Board(size=(1.0, 0.8))
ANGLES = np.radians(np.arange(-135, 135.01, 0.25))
CENTER, ALONG, LENGTH = np.array([2.4, 0.6]), np.array([np.sin(0.5), np.cos(0.5)]), 0.9
ENDS = np.stack([CENTER - 0.5 * LENGTH * ALONG, CENTER + 0.5 * LENGTH * ALONG])
ROOM = np.array([[(5, -4), (5, 4)], [(5, 4), (-3, 4)], [(5, -4), (-3, -4)], [(-3, -4), (-3, 4)]], dtype=float)


def cast_wall(start: Array, end: Array, angles: Array) -> Array:
    """Ranges (N,) to a straight wall, inf where beams miss it."""
    u = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    edge = np.asarray(end, dtype=float) - start
    cross = u[:, 0] * edge[1] - u[:, 1] * edge[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        r = (start[0] * edge[1] - start[1] * edge[0]) / cross
        at = (start[0] * u[:, 1] - start[1] * u[:, 0]) / cross
    return np.where((r > 0) & (at >= 0) & (at <= 1), r, np.inf)


def cast_leg(x: float, y: float, radius: float, angles: Array) -> Array:
    """Ranges (N,) to an upright cylinder."""
    along = x * np.cos(angles) + y * np.sin(angles)
    inside = radius**2 - (x**2 + y**2 - along**2)
    return np.where((inside > 0) & (along > 0), along - np.sqrt(np.maximum(inside, 0)), np.inf)


def ranges_to(
    walls: Sequence[Sequence[Array]], legs: Sequence[tuple[float, float, float]], angles: Array
) -> Array:
    cast = [cast_wall(a, b, angles) for a, b in walls]
    return np.asarray(np.min([*cast, *(cast_leg(*leg, angles) for leg in legs)], axis=0))


def measure(
    rng: np.random.Generator,
    *,
    ends: Array | None = ENDS,
    walls: Sequence[Array] | Array = ROOM,
    legs: Sequence[tuple[float, float, float]] = (),
    angles: Array = ANGLES,
    noise: RangeNoise = NOISE,
    dropouts: float = 0.02,
) -> LaserScan:
    """One noisy scan; a beam near an edge may average the two depths."""
    shapes = [*walls, *([ends] if ends is not None else [])]
    true = angles + rng.normal(0, noise.angle, len(angles))
    ranges, beside = ranges_to(shapes, legs, true), ranges_to(shapes, legs, true + rng.normal(0, 0.001, len(true)))
    edge = np.isfinite(ranges) & np.isfinite(beside) & (rng.random(len(true)) < 0.5)
    jump = np.where(edge, np.where(edge, beside, 0) - np.where(edge, ranges, 0), 0)
    ranges = ranges + np.where(np.abs(jump) > 0.2, rng.random(len(true)) * jump, 0)
    ranges = np.where(np.isfinite(ranges), ranges + rng.normal(0, noise.range, len(ranges)), np.inf)
    ranges[rng.random(len(ranges)) < dropouts] = np.nan
    return LaserScan(0.0, "laser", angles, ranges)


def accepted(result: tuple[Segment, ...] | Rejected) -> tuple[Segment, ...]:
    assert not isinstance(result, Rejected), result.reason
    return result


def rejection(result: tuple[Segment, ...] | Rejected) -> str:
    assert isinstance(result, Rejected), result
    return result.reason


def distances(segment: Segment, ends: Array = ENDS) -> Array:
    """(2,) perpendicular distances of the end points from the true line, m, signed."""
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    off = segment.endpoints[:, :2] - ends[0]
    return np.asarray(off @ np.array([-along[1], along[0]]))


def test_finds_a_board_without_background(rng: np.random.Generator) -> None:
    best = accepted(find_segments([measure(rng)], [BOARD], NOISE, None, rng, settings=DetectionSettings()))[0]
    assert np.abs(distances(best)).max() < 0.01
    assert np.linalg.norm(best.endpoints[:, :2] - ENDS, axis=1).max() < 0.04


def test_finds_a_board_with_background(rng: np.random.Generator) -> None:
    background = learn_scan_background([measure(rng, ends=None) for _ in range(20)])
    segments = accepted(
        find_segments([measure(rng)], [BOARD], NOISE, background, rng, settings=DetectionSettings())
    )
    assert len(segments) == 1
    assert np.abs(distances(segments[0])).max() < 0.01


def test_end_points_come_in_order_of_angle(rng: np.random.Generator) -> None:
    for segment in accepted(
        find_segments([measure(rng)], [BOARD], NOISE, None, rng, settings=DetectionSettings())
    ):
        first, last = np.arctan2(segment.endpoints[:, 1], segment.endpoints[:, 0])
        assert first < last


def test_operator_beside_the_board_does_not_extend_it(rng: np.random.Generator) -> None:
    background = learn_scan_background([measure(rng, ends=None) for _ in range(20)])
    leg = (*(ENDS[1] + 0.08 * ALONG), 0.08)
    scan = measure(rng, legs=[(float(leg[0]), float(leg[1]), leg[2])])
    best = accepted(find_segments([scan], [BOARD], NOISE, background, rng, settings=DetectionSettings()))[0]
    assert np.linalg.norm(best.endpoints[1, :2] - ENDS[1]) < 0.06
    assert np.abs(distances(best)).max() < 0.015


@pytest.mark.parametrize("end", [0, 1])
def test_what_stands_beside_the_board_off_its_line_is_cut_off(end: int, rng: np.random.Generator) -> None:
    """By 20 mm, little more than the noise of a beam, over 0.12 m."""
    background = learn_scan_background([measure(rng, ends=None) for _ in range(20)])
    outward = ALONG if end else -ALONG
    towards_scanner = np.array([-ALONG[1], ALONG[0]])
    piece = np.stack([ENDS[end], ENDS[end] + 0.12 * outward]) + 0.02 * towards_scanner
    lengths, offsets = [], []
    for _ in range(10):
        scans = [measure(rng, walls=[*ROOM, piece]) for _ in range(8)]
        best = accepted(find_segments(scans, [BOARD], NOISE, background, rng, settings=DetectionSettings()))[0]
        lengths.append(np.linalg.norm(np.diff(best.endpoints, axis=0)))
        offsets.append(distances(best))
    # The board is 0.9 m long, both together 1.02 m.
    assert np.mean(lengths) < 0.95
    assert np.abs(np.mean(offsets, axis=0)).max() < 0.003


def test_a_body_alone_is_a_bad_match(rng: np.random.Generator) -> None:
    background = learn_scan_background([measure(rng, ends=None) for _ in range(20)])
    result = find_segments(
        [measure(rng, ends=None, legs=[(2.0, 0.3, 0.2)])],
        [BOARD],
        NOISE,
        background,
        rng,
        settings=DetectionSettings(),
    )
    assert isinstance(result, Rejected) or result[0].match < 0.35


def test_repeated_scans_are_averaged(rng: np.random.Generator) -> None:
    one = accepted(find_segments([measure(rng)], [BOARD], NOISE, None, rng, settings=DetectionSettings()))[0]
    many = accepted(
        find_segments([measure(rng) for _ in range(16)], [BOARD], NOISE, None, rng, settings=DetectionSettings())
    )[0]
    n = np.array([-ALONG[1], ALONG[0], 0])
    ratio = (n @ many.covariance[:3, :3] @ n) / (n @ one.covariance[:3, :3] @ n)
    assert np.sqrt(ratio) == pytest.approx(0.25, rel=0.2)


def test_scans_without_any_return_change_nothing() -> None:
    rng = np.random.default_rng(3)
    full = [measure(rng) for _ in range(3)]
    empty = LaserScan(0.0, "scanner", ANGLES, np.full(len(ANGLES), np.nan))
    none = LaserScan(0.0, "scanner", np.zeros(0), np.zeros(0))
    [expected, found] = [
        accepted(
            find_segments(scans, [BOARD], NOISE, None, np.random.default_rng(5), settings=DetectionSettings())
        )[0]
        for scans in (full, [empty, none, *full, empty, none])
    ]
    np.testing.assert_array_equal(found.covariance, expected.covariance)
    np.testing.assert_array_equal(found.endpoints, expected.endpoints)


def test_a_board_across_the_seam_of_a_full_turn_is_one_segment(rng: np.random.Generator) -> None:
    around = np.linspace(0, 2 * np.pi, 1440, endpoint=False)
    ends = np.array([[1.5, -0.4], [1.6, 0.5]])
    best = accepted(
        find_segments(
            [measure(rng, ends=ends, angles=around)], [BOARD], NOISE, None, rng, settings=DetectionSettings()
        )
    )[0]
    assert np.linalg.norm(best.endpoints[1] - best.endpoints[0]) == pytest.approx(0.906, abs=0.04)


def test_beams_missing_in_dark_print_do_not_split_the_board(rng: np.random.Generator) -> None:
    scan = measure(rng, dropouts=0.3)
    best = accepted(find_segments([scan], [BOARD], NOISE, None, rng, settings=DetectionSettings()))[0]
    assert np.linalg.norm(best.endpoints[1] - best.endpoints[0]) == pytest.approx(LENGTH, abs=0.05)


def test_descending_angles_are_the_same_scan(rng: np.random.Generator) -> None:
    scan = measure(rng)
    reverse = LaserScan(0.0, "laser", scan.angles[::-1], scan.ranges[::-1])
    forward = accepted(
        find_segments([scan], [BOARD], NOISE, None, np.random.default_rng(1), settings=DetectionSettings())
    )[0]
    backward = accepted(
        find_segments([reverse], [BOARD], NOISE, None, np.random.default_rng(1), settings=DetectionSettings())
    )[0]
    assert np.allclose(forward.endpoints, backward.endpoints)


def test_covariance_is_that_of_repeated_scans() -> None:
    """Perpendicular errors of both end points, whitened, have the length that chi-square gives them."""
    total, seeds = 0.0, 150
    n = np.array([-ALONG[1], ALONG[0], 0])
    N = np.zeros((2, 6))
    N[0, :3], N[1, 3:] = n, n
    near = ANGLES[np.abs(ANGLES - 0.25) < 0.4]
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        scan = measure(rng, walls=[], angles=near)
        best = accepted(find_segments([scan], [BOARD], NOISE, None, rng, settings=DetectionSettings()))[0]
        error = distances(best)
        total += float(error @ np.linalg.solve(N @ best.covariance @ N.T, error))
    low, high = chi2.ppf([0.005, 0.995], 2 * seeds)
    assert low < total < high


def test_end_points_are_uncertain_by_the_beam_spacing_along_the_line(rng: np.random.Generator) -> None:
    best = accepted(find_segments([measure(rng)], [BOARD], NOISE, None, rng, settings=DetectionSettings()))[0]
    t = np.append(ALONG, 0)
    for i in range(2):
        end = best.endpoints[i]
        cosine = abs(np.cross(t, end / np.linalg.norm(end))[2])
        spacing = np.radians(0.25) * np.linalg.norm(end) / cosine
        own = best.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        assert np.sqrt(t @ own @ t) == pytest.approx(spacing / np.sqrt(12), rel=0.15)
        assert own[2, 2] == pytest.approx(1e-8)


def test_a_wall_is_too_long(rng: np.random.Generator) -> None:
    wall = np.array([[3.0, -2.5], [3.0, 2.5]])
    reason = rejection(
        find_segments([measure(rng, ends=wall, walls=[])], [BOARD], NOISE, None, rng, settings=DetectionSettings())
    )
    assert "the board 1 x 0.8 m" in reason
    assert "4.9" in reason or "5.0" in reason


def test_rejection_names_missing_scans(rng: np.random.Generator) -> None:
    assert "no scan" in rejection(find_segments([], [BOARD], NOISE, None, rng, settings=DetectionSettings()))


def test_rejection_names_empty_scans(rng: np.random.Generator) -> None:
    blind = LaserScan(0.0, "laser", ANGLES, np.full(len(ANGLES), np.inf))
    assert "no steady returns" in rejection(
        find_segments([blind], [BOARD], NOISE, None, rng, settings=DetectionSettings())
    )


def test_rejection_names_missing_foreground(rng: np.random.Generator) -> None:
    background = learn_scan_background([measure(rng, ends=None) for _ in range(20)])
    still = [measure(rng, ends=None) for _ in range(5)]
    assert "no foreground beams" in rejection(
        find_segments(still, [BOARD], NOISE, background, rng, settings=DetectionSettings())
    )


def test_rejection_names_too_few_beams(rng: np.random.Generator) -> None:
    edge_on = np.array([[2.0, 0.5], [2.3, 0.6]])
    scan = measure(rng, ends=edge_on, walls=[], dropouts=0.0)
    assert "is edge-on" in rejection(
        find_segments([scan], [BOARD], NOISE, None, rng, settings=DetectionSettings())
    )


def test_finds_the_board_first_in_every_real_scan(data_dir: Path, rng: np.random.Generator) -> None:
    """The board is 0.50 x 0.30 m by the proportions of the images, 0.7 to 1.2 m before the scanner."""
    files = sorted((data_dir / "acfr-rpg-camera-2dlidar" / "lasers").glob("*.pcd"))
    assert len(files) == 5
    for file in files:
        xy = np.loadtxt(file, skiprows=11)[:, :2]
        ranges = np.hypot(*xy.T)
        order = np.argsort(np.arctan2(xy[:, 1], xy[:, 0]))
        scan = LaserScan(
            0.0, "laser", np.arctan2(xy[:, 1], xy[:, 0])[order], np.where(ranges > 0, ranges, np.inf)[order]
        )
        best = accepted(
            find_segments([scan], [Board(size=(0.5, 0.3))], RangeNoise(), None, rng, settings=DetectionSettings())
        )[0]
        assert 0.7 < best.center[0] < 1.2
        assert np.linalg.norm(best.endpoints[1] - best.endpoints[0]) == pytest.approx(0.5, abs=0.04)


EXACT = RangeNoise(range=0.005, angle=1e-4)
FINE = np.radians(np.arange(-60, 60, 0.25))


def board_scan(
    beyond: float | Callable[[Array], Array] = 5.0,
    *,
    length: float = 0.9,
    bulge: float = 0.0,
    angles: Array = FINE,
) -> LaserScan:
    """A board 2 m ahead, across the view, whose middle bulges backwards, and what beams beside it measure."""
    s = 2 * np.tan(angles)
    depth = 2.0 - bulge * (s / (length / 2)) ** 2
    other = beyond(angles) if callable(beyond) else np.full(len(angles), beyond)
    return LaserScan(0.0, "laser", angles, np.where(np.abs(s) <= length / 2, depth / np.cos(angles), other))


def score(scan: LaserScan) -> float:
    """Of the candidate 2 m ahead."""
    found = accepted(
        find_segments([scan], [BOARD], EXACT, None, np.random.default_rng(0), settings=DetectionSettings())
    )
    return next(s.match for s in found if np.abs(s.center - [2.0, 0, 0]).max() < 0.1)


def test_a_straight_free_line_of_the_boards_length_has_the_full_score() -> None:
    assert score(board_scan()) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("length", [0.3, 0.4, 0.6])
def test_lines_shorter_than_the_shorter_side_score_in_proportion(length: float) -> None:
    assert score(board_scan(length=length)) == pytest.approx(length / 0.8, abs=0.03)


@pytest.mark.parametrize("bulge", [-0.01, 0.005, 0.01])
def test_bulging_lines_score_less(bulge: float) -> None:
    assert score(board_scan(bulge=bulge)) == pytest.approx(np.exp(-0.5 * (bulge / 0.01) ** 2), abs=0.05)


def beside(left: float, right: float) -> Callable[[Array], Array]:
    """Ranges to either side, up to 30 degrees from the middle, and of 5 m farther outwards."""
    return lambda angles: np.where(np.abs(angles) > np.radians(30), 5.0, np.where(angles > 0, left, right))


@pytest.mark.parametrize(
    ("beyond", "expected"),
    [
        (beside(1.5, 5.0), np.sqrt(0.7)),  # something nearer hides one end
        (beside(1.5, 1.5), 0.7),
        (beside(np.nan, 5.0), np.sqrt(0.8)),  # no return beside it
        (beside(np.nan, np.nan), 0.8),
        (lambda angles: 2.05 / np.cos(angles), 0.2),  # less than the least depth jump behind it
        (lambda angles: 2.25 / np.cos(angles), 1.0),
    ],
)
def test_ends_are_scored_by_what_follows_them(beyond: Callable[[Array], Array], expected: float) -> None:
    assert score(board_scan(beyond)) == pytest.approx(expected, abs=0.01)


def test_an_end_at_the_end_of_the_field_of_view_may_be_none() -> None:
    # The last beam on the board is the last one of the scan.
    assert score(board_scan(angles=FINE[2 * np.tan(FINE) <= 0.45])) == pytest.approx(np.sqrt(0.7), abs=0.01)
