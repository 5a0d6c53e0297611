"""Two boards in one capture, which cameras identify and scanners do not."""

import numpy as np
import pytest

from board_scenes import SIZE, make_boards, make_patch, random_pose
from calgraph.boards.detections import BoardCorners, Detection
from calgraph.config.settings import BoardPairSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3
from calgraph.rig.pairs.board_matches import Candidates, tabulate_matches
from calgraph.rig.pairs.board_pair import estimate_pair

CAPTURES = 12


def corners(T_s_board: Array, board: int, rng: np.random.Generator) -> BoardCorners:
    patch = make_patch(T_s_board, rng)
    return BoardCorners(
        np.zeros((4, 3)), np.zeros((4, 2)), T_s_board, 1e-6 * np.eye(6), patch.plane, patch.covariance, 0.1, board
    )


def scene(rng: np.random.Generator) -> tuple[Array, Array]:
    """Two boards (C, 4, 4) in every capture."""
    both = make_boards(rng, 2 * CAPTURES)
    return both[:CAPTURES], both[CAPTURES:]


def by_camera(T_s_root: Array, both: tuple[Array, Array], rng: np.random.Generator) -> Candidates:
    return {
        i: tuple(corners(T_s_root @ T[i], board, rng) for board, T in enumerate(both)) for i in range(CAPTURES)
    }


def by_lidar(T_s_root: Array, both: tuple[Array, Array], rng: np.random.Generator) -> Candidates:
    """In either order."""
    found: dict[int, tuple[Detection, ...]] = {}
    for i in range(CAPTURES):
        order = rng.permutation(2)
        found[i] = tuple(make_patch(T_s_root @ both[k][i], rng) for k in order)
    return found


def test_cameras_do_not_match_different_boards() -> None:
    rng = np.random.default_rng(1)
    both = scene(rng)
    table = tabulate_matches(by_camera(np.eye(4), both, rng), by_camera(np.eye(4), both, rng))
    assert len(table) == 2 * CAPTURES
    assert (table[:, 1] == table[:, 2]).all()


def test_cameras_that_never_identify_the_same_board_have_no_pair(rng: np.random.Generator) -> None:
    both = by_camera(np.eye(4), scene(rng), rng)
    a, b = ({i: found[board : board + 1] for i, found in both.items()} for board in (0, 1))
    assert estimate_pair("a", "b", a, b, SIZE, rng, settings=BoardPairSettings()) == Rejected(
        "no capture in which both detected the same board"
    )


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("observe_b", [by_camera, by_lidar], ids=["camera", "lidar"])
@pytest.mark.parametrize("swapped", [False, True])
def test_both_boards_of_a_capture_are_used(seed: int, observe_b: object, swapped: bool) -> None:
    rng = np.random.default_rng(seed)
    both = scene(rng)
    T_a_b = random_pose(rng)
    a, b = by_camera(np.eye(4), both, rng), observe_b(se3.inverse(T_a_b), both, rng)  # type: ignore[operator]
    found = (
        estimate_pair("b", "a", b, a, SIZE, rng, settings=BoardPairSettings())
        if swapped
        else estimate_pair("a", "b", a, b, SIZE, rng, settings=BoardPairSettings())
    )
    assert not isinstance(found, Rejected), found
    assert found.inliers.sum() == 2 * CAPTURES
    T = se3.inverse(found.T_a_b) if swapped else found.T_a_b
    assert np.linalg.norm(se3.difference(T, T_a_b)[:3]) < 0.01
    assert np.linalg.norm(se3.difference(T, T_a_b)[3:]) < 0.01


def test_scanners_use_one_board_of_a_capture() -> None:
    """They cannot distinguish two boards from two detections of one board."""
    rng = np.random.default_rng(3)
    both = scene(rng)
    found = estimate_pair(
        "a",
        "b",
        by_lidar(np.eye(4), both, rng),
        by_lidar(np.eye(4), both, rng),
        SIZE,
        rng,
        settings=BoardPairSettings(),
    )
    assert not isinstance(found, Rejected), found
    assert found.inliers.sum() == CAPTURES
    assert np.linalg.norm(se3.difference(found.T_a_b, np.eye(4))) < 0.02
