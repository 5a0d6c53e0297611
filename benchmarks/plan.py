"""How near ``calgraph plan`` comes to the uncertainty that calibrations of simulated recordings then publish.

python benchmarks/plan.py             # five rigs of each of the four kinds of model_errors.py
python benchmarks/plan.py --rigs five --seeds 10

The plan gets the rig, the true poses, the true fields of view and the number of captures. Ideal detectors simulate
the captures, with systematic errors drawn from the priors, and with the usual bias of each view. The board is held
in three ways: ``planned``, at other places drawn as the plan draws them; ``walk``, as the scenario of the rig
has it; ``same``, as in the walk, and the plan gets these boards, so that only its model is tested.

A ratio is the predicted over the published standard deviation, of a sensor's worst axis: of its position, and of
its rotation.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from calgraph.geometry import Array
from calgraph.result.sensor_pose import stddev_along_axes
from calgraph.rig.fields_of_view import FieldOfView, PlannedRig
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.rig.recording_plan import detect_boards, draw_boards, plan_captures, plan_recording
from calgraph.simulation import World, ground_truth, world_rig
from calgraph.simulation.motion import BoardPlacement, pose_from_placement, schedule_holds
from ideal_detections import IdealDetectorOptions, simulate_detections
from model_error_draws import draw_errors
from model_error_rigs import SCENARIOS, cameras_of, rig_world, scanners_of
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

    def ratio(self, axes: slice) -> float:
        """Of the worst axis among some."""
        return float(self.predicted[axes].max() / self.published[axes].max())


def main() -> None:
    """Prints ratios by rig and walk."""
    parser = make_parser(__doc__, jobs=1)
    parser.add_argument("--rigs", nargs="+", choices=SCENARIOS, default=list(SCENARIOS))
    parser.add_argument("--seeds", type=int, default=5, help="rigs of each kind")
    parser.add_argument("--walks", nargs="+", choices=WALKS, default=list(WALKS))
    arguments = parser.parse_args()
    work = [(r, seed, walk) for r in arguments.rigs for seed in range(arguments.seeds) for walk in arguments.walks]
    rows = run_worlds(Row, measure, work, arguments, key=3)
    table = Layout("walk:8 rig:8 sensors:>8 median:>7.2f least:>6.2f most:>6.2f 0.8-1.25:>9")
    print(table.head)
    for walk, of_walk in grouped(rows, lambda row: row.walk):
        for rig, found in [*grouped(of_walk, lambda row: row.rig), ("all", of_walk)]:
            ratios = [row.ratio(axes) for row in found for axes in (slice(3), slice(3, 6))]
            within = [one for one in ratios if TARGET[0] <= one <= TARGET[1]]
            print(
                table.line(walk, rig, len(found), median(ratios), min(ratios), max(ratios), share(within, ratios))
            )


def measure(rig: str, seed: int, walk: str) -> list[Row]:
    """Plans and calibrates one recording."""
    world = rig_world(rig, seed)
    if walk == "planned":
        drawn = draw_boards(describe_world(world), np.random.default_rng((seed, 1)))
        world = hold_boards(world, detect_boards(describe_world(world), drawn, world.scenario.captures)[0])
    errors, board = draw_errors(world, np.random.default_rng(seed)), world.scenario.board
    biased = replace(errors.board, view_bias=VIEW_BIAS, view_tilt=2 * VIEW_BIAS / max(board.size))
    stated, captured, truth = simulate_detections(
        world, seed, IdealDetectorOptions(), replace(errors, board=biased)
    )
    planned, captures = replace(describe_world(world), rig=stated), captured.count_shared()
    if walk == "same":
        boards = detect_boards(planned, [one.T_root_board for one in truth.boards], len(truth.boards))
        plan = plan_captures(planned, captures, *boards)
    else:
        plan = plan_recording(planned, captures, np.random.default_rng(0))
    problem = build_problem_from_captures(stated, captured, RigOptions(folds=0), np.random.default_rng(seed))
    calibration = solve_problem(problem)
    published = {one.name: stddev_along_axes(one.T_root_sensor, one.covariance) for one in calibration.sensors}
    return [
        Row(rig, seed, walk, one.name, captures, published[one.name], one.stddev)
        for one in plan.sensors
        if one.name in published
    ]


def describe_world(world: World) -> PlannedRig:
    """What is known of a simulated rig."""
    fields: dict[str, FieldOfView] = {camera.name: camera.camera for camera in cameras_of(world)}
    fields |= {scanner.name: scanner.pattern for scanner in scanners_of(world)}
    T_root_sensor = ground_truth(world).T_root_sensor
    return PlannedRig(world_rig(world), fields, {world.root: T_root_sensor[world.root], **T_root_sensor})


def hold_boards(world: World, T_root_board: Array) -> World:
    """The world with boards (C, 4, 4) instead of its walk."""
    (T_world_root,) = (sensor.T_world_sensor for sensor in world.robot if sensor.name == world.root)
    placements = [_place(T) for T in T_world_root @ T_root_board]
    trajectory = schedule_holds(
        placements,
        background=world.scenario.background,
        move_time=world.scenario.move_time,
        hold_end=lambda start: start + 1.0,
        placements_after_slip=[None] * len(placements),
    )
    return replace(world, trajectory=trajectory)


def _place(T_world_board: Array) -> BoardPlacement:
    x, y, z = T_world_board[:3, 3].tolist()
    facing = BoardPlacement(float(np.arctan2(y, x)), float(np.hypot(x, y)), z, np.eye(3))
    return replace(facing, R_facing_board=pose_from_placement(facing)[:3, :3].T @ T_world_board[:3, :3])


if __name__ == "__main__":
    main()
