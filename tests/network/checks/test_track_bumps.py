"""Bumps of scanners without static background, from tracks."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.geometry import Array, se2
from calgraph.network.checks.track_bumps import find_track_bump
from calgraph.network.tracking.track import ScannerBump, ScannerTracks, Track

NAMES = ("west", "east", "north")
T_ROOT = se2.pose(np.array([0.0, 2.5, -1.5]), np.array([[0.0, 0.0], [8.0, 1.0], [4.0, 6.0]]))
SIGMA = 0.03
TIMES = 1000.0 + np.arange(0, 60, 0.08)
STILL = np.zeros(3)


def walk(times: Array, number: int) -> Array:
    """(T, 2) a person's path in the root frame."""
    angle = 0.35 * (times - 1000.0) + 2.2 * number
    return np.column_stack([4 + 2.5 * np.cos(angle) + np.cos(0.4 * angle), 3 + 2 * np.sin(1.3 * angle)])


def observe(
    name: str, rng: np.random.Generator, bump: Array = STILL, at: float = 30.0, people: int = 2
) -> ScannerTracks:
    """The tracks of a scanner whose pose has a step, in its frame, at a time."""
    T = np.broadcast_to(T_ROOT[NAMES.index(name)], (len(TIMES), 3, 3)).copy()
    T[1000.0 + at < TIMES] = T[0] @ se2.pose(bump[2], bump[:2])
    tracks = []
    for number in range(people):
        x = se2.apply(se2.inverse(T), walk(TIMES, number)[:, None])[:, 0]
        covariances = np.tile(SIGMA**2 * np.eye(2), (len(TIMES), 1, 1))
        v = np.gradient(x, TIMES, axis=0)
        tracks.append(Track(TIMES, x + rng.normal(0, SIGMA, x.shape), v, covariances, period=0))
    return ScannerTracks(tuple(tracks), np.zeros((0, 2)), 0.01)


def find(tracked: dict[str, ScannerTracks], T_root_scanner: Array = T_ROOT) -> tuple[str, ScannerBump] | None:
    return find_track_bump(tracked, NAMES, T_root_scanner, np.zeros(3))


def network(rng: np.random.Generator, bumped: str, bump: Array, at: float = 30.0) -> dict[str, ScannerTracks]:
    return {name: observe(name, rng, bump if name == bumped else STILL, at) for name in NAMES}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("bump", [(0.0, 0.0, 0.05), (0.15, 0.1, 0.0), (0.1, 0.0, -0.17)])
def test_the_bumped_scanner_is_found(
    rng: np.random.Generator, name: str, bump: tuple[float, float, float]
) -> None:
    found = find(network(rng, name, np.array(bump)))
    assert found is not None
    assert found[0] == name
    step = found[1]
    assert step.translation == pytest.approx(np.hypot(*bump[:2]), abs=4 * step.translation_stddev)
    assert step.rotation == pytest.approx(bump[2], abs=4 * step.rotation_stddev)


def test_the_interval_contains_the_time(rng: np.random.Generator) -> None:
    found = find(network(rng, "east", np.array([0.0, 0.0, 0.05]), at=40.0))
    assert found is not None
    begin, end = found[1].interval
    assert begin < 1040.1
    assert end > 1039.9
    assert end - begin < 3.0


def test_a_bump_is_found_if_the_pose_is_that_of_either_side(rng: np.random.Generator) -> None:
    bump = np.array([0.0, 0.0, 0.1])
    T = T_ROOT.copy()
    T[1] = T[1] @ se2.pose(bump[2], bump[:2])
    found = find(network(rng, "east", bump, at=20.0), T)
    assert found is not None
    assert found[0] == "east"


def test_scanners_at_rest_have_no_bump(rng: np.random.Generator) -> None:
    assert find(network(rng, "", STILL)) is None


def test_wrong_poses_are_no_bumps(rng: np.random.Generator) -> None:
    T = T_ROOT.copy()
    T[1] = T[1] @ se2.pose(0.03, np.array([0.1, 0.0]))
    assert find(network(rng, "", STILL), T) is None


def test_scanners_whose_background_was_tested_are_left_out(rng: np.random.Generator) -> None:
    tracked = network(rng, "east", np.array([0.0, 0.0, 0.05]))
    assert find({name: replace(one, background_tested=True) for name, one in tracked.items()}) is None


def test_a_bump_shortly_before_the_end_is_not_tested(rng: np.random.Generator) -> None:
    assert find(network(rng, "east", np.array([0.0, 0.0, 0.05]), at=55.0)) is None


def test_a_scanner_without_common_positions_is_not_tested(rng: np.random.Generator) -> None:
    alone = observe("east", rng)
    later = tuple(replace(track, times=track.times + 100.0) for track in alone.tracks)
    assert find({**network(rng, "", STILL), "east": replace(alone, tracks=later)}) is None
