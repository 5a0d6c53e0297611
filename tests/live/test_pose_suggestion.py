"""Suggested board poses of live captures: a person reaches them, and they do not repeat the last one."""

from collections.abc import Callable

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.geometry import Array, se3, so3
from calgraph.live.rig_solution import suggest_next_pose
from calgraph.report.pose_picture import estimate_up
from calgraph.rig.bundle.solution import SolvedBundle
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_jointly
from calgraph.simulation import LaserOptions, RigScenario, SpinningOptions, build_world
from ideal_detections import simulate_detections

SCENARIO = RigScenario(
    laser=LaserOptions(count=1, resolution=0.5),
    spinning=SpinningOptions(resolution=1.0, scans_per_degree=1 / 6),
    bearings=(20, -20, 0, -30, 30, 10),
    radii=(1.7,),
    samples=1,
)


@pytest.fixture(scope="module")
def solved() -> tuple[Rig, SolvedBundle]:
    rig, captures, _ = simulate_detections(build_world(SCENARIO, 0, images=False), 0)
    problem = build_problem_from_captures(rig, captures, RigOptions(), np.random.default_rng(0))
    bundle = solve_jointly(problem)[0].solved_bundle
    assert bundle is not None
    return rig, bundle


def test_last_suggestion_is_not_repeated(solved: tuple[Rig, SolvedBundle]) -> None:
    first = suggest_next_pose(*solved, None)
    assert first is not None
    again = suggest_next_pose(*solved, first)
    assert again is not None
    assert np.linalg.norm(again.T_root_board[:3, 3] - first.T_root_board[:3, 3]) >= 0.25


def test_height_is_near_that_of_the_boards_until_now(
    solved: tuple[Rig, SolvedBundle], monkeypatch: pytest.MonkeyPatch
) -> None:
    rig, bundle = solved
    monkeypatch.setattr("calgraph.live.rig_solution._MAX_HEIGHT_CHANGE", 0.05)
    found = suggest_next_pose(rig, bundle, None)
    assert found is not None
    up = estimate_up({"lidar": "lidar3d"}, {"lidar": np.eye(4)})
    heights = bundle.minimized.state.T_root_board[:, :3, 3] @ up
    assert abs(found.T_root_board[:3, 3] @ up - np.median(heights)) < 0.1


def test_board_is_held_upright_but_for_tilt_and_turn(solved: tuple[Rig, SolvedBundle]) -> None:
    found = suggest_next_pose(*solved, None)
    assert found is not None
    assert found.T_root_board[2, 1] > 0.3


def test_none_is_suggested_where_none_is_reached(
    solved: tuple[Rig, SolvedBundle], monkeypatch: pytest.MonkeyPatch
) -> None:
    rig, bundle = solved
    monkeypatch.setattr("calgraph.live.rig_solution._MIN_DISTANCE", 50.0)
    assert suggest_next_pose(rig, bundle, None) is None


@pytest.mark.parametrize("kind", ["lidar2d", "camera"])
def test_up_is_that_of_most_sensors(kind: str) -> None:
    make: Callable[[Array], Array] = lambda R: se3.pose(R, np.zeros(3))  # noqa: E731
    optical = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    sideways = so3.exp(np.array([np.pi / 2, 0, 0]))
    poses = {
        "a": make(sideways @ (optical if kind == "camera" else np.eye(3))),
        "b": make(so3.exp(np.array([0.05, 0, 0]))),
        "c": make(optical),
    }
    up = estimate_up({"a": kind, "b": "lidar3d", "c": "camera"}, poses)
    assert up[2] > 0.99
