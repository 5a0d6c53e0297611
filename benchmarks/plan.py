"""How near ``calgraph plan`` comes to the uncertainty that calibrations of simulated recordings then publish.

python benchmarks/plan.py             # five rigs of each of the four kinds of model_errors.py
python benchmarks/plan.py --rigs five --seeds 10

The plan gets the rig, the true poses, the true fields of view and the number of captures. Ideal detectors simulate
the captures, with systematic errors drawn from the priors, and with the usual bias of each view. The board is held
in three ways: ``planned``, at other places drawn as the plan draws them; ``walk``, as the scenario of the rig
has it; ``same``, as in the walk, and the plan gets these boards, so that only its model is tested.

A ratio is the predicted over the published standard deviation: of the worst axis of each sensor's position and of
its rotation; in the rows ``worst``, of the axis of each rig with the largest share of the tolerance, which decides
how many captures suffice.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from calgraph.config import Tolerance
from calgraph.geometry import Array
from calgraph.result.sensor_pose import stddev_along_axes
from calgraph.rig.fields_of_view import FieldOfView, PlannedRig
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.rig.recording_plan import detect_boards, draw_boards, plan_captures, plan_recording
from calgraph.simulation import World, ground_truth, world_rig
from calgraph.simulation.motion import SimulatedHold
from ideal_detections import simulate_detections
from model_error_draws import draw_errors
from model_error_rigs import SCENARIOS, cameras_of, rig_world, scanners_of
from remedies import place_board
from worlds import Layout, grouped, make_parser, median, run_worlds, share

VIEW_BIAS = 0.0015
"""Standard deviation of the displacement of each view, m, and of its rotation times half a board."""
TARGET = 0.8, 1.25
WALKS = "planned", "walk", "same"


class Row(NamedTuple):
    """One sensor of one recording."""

    rig: str
    seed: int
    walk: str
    sensor: str
    captures: int
    """That two sensors or more detect."""
    published: Array
    """(6,) standard deviations along and about its axes, m and rad, of the calibration,"""
    predicted: Array
    """(6,) and of the plan."""


def main() -> None:
    """Prints ratios by rig and walk."""
    parser = make_parser(__doc__, jobs=1)
    parser.add_argument("--rigs", nargs="+", choices=SCENARIOS, default=list(SCENARIOS))
    parser.add_argument("--seeds", type=int, default=5, help="rigs of each kind")
    arguments = parser.parse_args()
    work = [(rig, seed, walk) for rig in arguments.rigs for seed in range(arguments.seeds) for walk in WALKS]
    rows = run_worlds(Row, measure, work, arguments, key=3)
    table = Layout("walk:8 rig:8 ratios:>7 median:>7.2f least:>6.2f most:>6.2f 0.8-1.25:>9")
    print(table.head)
    for walk, of_walk in grouped(rows, lambda row: row.walk):
        parts = {rig: compare_axes(found) for rig, found in grouped(of_walk, lambda row: row.rig)}
        worst = [compare_worst(found) for _, found in grouped(of_walk, lambda row: (row.rig, row.seed))]
        for part, ratios in {**parts, "all": compare_axes(of_walk), "worst": worst}.items():
            within = share([one for one in ratios if TARGET[0] <= one <= TARGET[1]], ratios)
            print(table.line(walk, part, len(ratios), median(ratios), min(ratios), max(ratios), within))


def compare_axes(rows: Sequence[Row]) -> list[float]:
    """Ratios of the worst axis of each position and rotation."""
    axes = slice(3), slice(3, 6)
    return [float(row.predicted[part].max() / row.published[part].max()) for row in rows for part in axes]


def compare_worst(rows: Sequence[Row]) -> float:
    """The ratio of the axis with the largest share of the tolerance."""
    limits = Tolerance().limits
    return float(max((r.predicted / limits).max() for r in rows) / max((r.published / limits).max() for r in rows))


def measure(rig: str, seed: int, walk: str) -> list[Row]:
    """Plans and calibrates one recording."""
    world = rig_world(rig, seed)
    if walk == "planned":
        drawn = draw_boards(describe_world(world), np.random.default_rng((seed, 1)))
        world = hold_boards(world, detect_boards(describe_world(world), drawn, world.scenario.captures)[0])
    errors, board = draw_errors(world, np.random.default_rng(seed)), world.scenario.board
    biased = replace(errors.board, view_bias=VIEW_BIAS, view_tilt=2 * VIEW_BIAS / max(board.size))
    stated, captured, truth = simulate_detections(world, seed, None, replace(errors, board=biased))
    planned, captures = replace(describe_world(world), rig=stated), captured.count_shared()
    if walk == "same":
        boards = [one.T_root_board for one in truth.boards]
        plan = plan_captures(planned, captures, *detect_boards(planned, boards, len(boards)))
    else:
        plan = plan_recording(planned, captures, np.random.default_rng(0))
    problem = build_problem_from_captures(stated, captured, RigOptions(folds=0), np.random.default_rng(seed))
    found = {
        one.name: stddev_along_axes(one.T_root_sensor, one.covariance) for one in solve_problem(problem).sensors
    }
    return [
        Row(rig, seed, walk, name, captures, found[name], stddev)
        for name, stddev in ((one.name, one.stddev) for one in plan.sensors)
        if name in found
    ]


def describe_world(world: World) -> PlannedRig:
    """What is known of a simulated rig."""
    fields: dict[str, FieldOfView] = {camera.name: camera.camera for camera in cameras_of(world)}
    fields |= {scanner.name: scanner.pattern for scanner in scanners_of(world)}
    T_root_sensor = ground_truth(world).T_root_sensor
    return PlannedRig(world_rig(world), fields, {world.root: T_root_sensor[world.root], **T_root_sensor})


def hold_boards(world: World, T_root_board: Array) -> World:
    """The world with boards (C, 4, 4) instead of its walk, each for a second."""
    (T_world_root,) = (sensor.T_world_sensor for sensor in world.robot if sensor.name == world.root)
    holds = []
    for i, T_world_board in enumerate(T_world_root @ T_root_board):
        holds.append(SimulatedHold(i, i + 1.0, place_board(T_world_board)))
    empty = replace(world.trajectory, times=np.array([np.inf]), holds=tuple(holds))
    return replace(world, trajectory=empty)


if __name__ == "__main__":
    main()
