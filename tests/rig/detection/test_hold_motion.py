"""Boards that move between the messages of a hold, by rays that are intersected with them."""

from collections.abc import Sequence

import numpy as np
import pytest

from calgraph.boards.detections import PlanePatch, Segment, to_beams
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3, so3
from calgraph.rig.detection.hold_motion import drop_moved, has_moved

T_SENSOR_BOARD = se3.pose(so3.exp(np.array([0.2, -1.2, 0.1])), np.array([2.6, 0.5, 0.1]))
NOISE = 0.02
"""m."""


def sweep(rings: int, T_sensor_board: Array, rng: np.random.Generator) -> Array:
    """(N, 3) returns of a board of 1.0 x 0.8 m to beams 0.25° apart in rings 2° apart, or in one plane."""
    azimuth = np.arctan2(0.5, 2.6) + np.radians(np.arange(-20, 20, 0.25))
    elevation = np.radians(2.0) * (np.arange(rings) - (rings - 1) / 2)
    a, e = (grid.ravel() for grid in np.meshgrid(azimuth, elevation))
    directions = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    n = T_sensor_board[:3, 2]
    ranges = (n @ T_sensor_board[:3, 3]) / (directions @ n)
    at = se3.apply(se3.inverse(T_sensor_board), ranges[:, None] * directions)
    hit = np.all(np.abs(at[:, :2]) <= [0.5, 0.4], axis=1)
    return np.asarray(((ranges + NOISE * rng.normal(size=len(ranges)))[:, None] * directions)[hit])


def detect(rings: int, messages: Sequence[Array]) -> PlanePatch | Segment:
    """The board where it stands at first."""
    points = np.concatenate(messages)
    ranges, directions = to_beams(points)
    n, t = T_SENSOR_BOARD[:3, 2], T_SENSOR_BOARD[:3, 3]
    if rings > 1:
        return PlanePatch(np.array([*n, -n @ t]), np.eye(3), ranges, directions, messages[0].mean(axis=0))
    return Segment(messages[0][[0, -1]], np.eye(6), ranges, directions)


def measure(rings: int, step: Array, seed: int, count: int = 5) -> tuple[PlanePatch | Segment, list[Array]]:
    """Messages, of which the second half measures the board after a step."""
    rng, moved = np.random.default_rng(seed), se3.pose(so3.exp(step[3:]), step[:3])
    poses = [T_SENSOR_BOARD @ (moved if k >= count / 2 else np.eye(4)) for k in range(count)]
    messages = [sweep(rings, T, rng) for T in poses]
    return detect(rings, messages), messages


@pytest.mark.parametrize("rings", [1, 16])
def test_noise_is_no_motion(rings: int) -> None:
    # The level is 6e-5: one alarm in 300 has a probability of 2 %.
    assert sum(has_moved(*measure(rings, np.zeros(6), seed)) for seed in range(300)) <= 1


@pytest.mark.parametrize("rings", [1, 16])
@pytest.mark.parametrize(
    "step",
    [[0, 0, 0.04, 0, 0, 0], [0, 0, -0.04, 0, 0, 0], [0, 0, 0, 0.05, 0.2, 0], [0, 0, 0.5, 0, 0, 0]],
    ids=["towards", "away", "turned", "carried_away"],
)
def test_a_step_is_motion(rings: int, step: list[float]) -> None:
    moved = [has_moved(*measure(rings, np.array(step), seed, count=10)) for seed in range(20)]
    assert np.mean(moved) >= 0.95


def test_a_hand_that_gives_way_by_millimetres_is_accepted() -> None:
    assert not any(has_moved(*measure(16, np.array([0, 0, 0.003, 0, 0, 0]), seed, count=40)) for seed in range(20))


def test_one_message_shows_no_motion() -> None:
    board, messages = measure(16, np.zeros(6), 0, count=1)
    assert drop_moved([board], messages) == (board,)


def test_the_candidate_that_moved_is_dropped() -> None:
    still, messages = measure(16, np.zeros(6), 0)
    carried, others = measure(16, np.array([0, 0, 0.3, 0, 0, 0]), 0)
    assert drop_moved([still], messages) == (still,)
    assert drop_moved([carried], others) == Rejected("board moved between messages: hold it still")
