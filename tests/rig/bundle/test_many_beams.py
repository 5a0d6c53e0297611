"""A scanner with more beams on boards than a solution needs: each view's are thinned."""

import numpy as np
import pytest

from calgraph.boards.detections import PlanePatch
from calgraph.config import RangeNoise
from calgraph.geometry import Array
from calgraph.rig.bundle.normal_equations import accumulate
from calgraph.rig.bundle.range_observations import RangeObservations

NOISE = RangeNoise(range=0.01, angle=1e-4)
RINGS = 16
VIEWS = 10
LIMIT = 250_000
T_SENSOR_BOARD = np.array([[[0, 0, -1.0, 2], [-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]])


def observe(columns: list[int]) -> RangeObservations:
    """Views of a board 2 m ahead by 16 rings, column after column as a LiDAR sends them."""
    return RangeObservations.from_detections(
        range(len(columns)), [scan_board(count) for count in columns], NOISE, min_cosine=0.05
    )


def scan_board(columns: int) -> PlanePatch:
    azimuth, elevation = np.meshgrid(np.linspace(-0.2, 0.2, columns), np.linspace(-0.1, 0.1, RINGS), indexing="ij")
    flat = np.cos(elevation)
    directions = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1).reshape(-1, 3)
    noise = np.random.default_rng(columns).normal(0, NOISE.range, len(directions))
    return PlanePatch(
        np.array([-1.0, 0, 0, 2]), np.eye(3), 2 / directions[:, 0] + noise, directions, np.array([2.0, 0, 0])
    )


def information(views: RangeObservations) -> Array:
    """(V, 3, 3) of the boards' planes."""
    T = np.repeat(T_SENSOR_BOARD, len(views.board), axis=0)
    return accumulate(views.linearize(T, np.zeros(0)), views.start, huber_threshold=1e9).JtJ


def count_beams(views: RangeObservations) -> list[int]:
    return [int(n) for n in np.diff(views.start, append=len(views.ranges))]


def test_all_beams_are_used_up_to_the_limit() -> None:
    assert count_beams(observe([1562] * VIEWS)) == [1562 * RINGS] * VIEWS


def test_large_views_share_the_limit_and_small_ones_keep_all_beams() -> None:
    assert count_beams(observe([3000] * (VIEWS - 1) + [20])) == [LIMIT // VIEWS] * (VIEWS - 1) + [20 * RINGS]


@pytest.mark.parametrize("columns", [2000, 4000, 12_500])
def test_thinned_views_measure_planes_as_well_as_their_share_of_beams(columns: int) -> None:
    """In all three directions: of every n-th beam, all may be of one ring, which measures two."""
    thinned, complete = information(observe([columns] + [20] * (VIEWS - 1)))[:1], information(observe([columns]))
    share = LIMIT / VIEWS / (RINGS * columns)
    whiten = np.linalg.inv(np.linalg.cholesky(complete))
    ratio = np.linalg.eigvalsh(whiten @ thinned @ whiten.transpose(0, 2, 1))
    np.testing.assert_allclose(ratio, share, rtol=0.01)
