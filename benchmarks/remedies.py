"""Remedies that a calibration states, against calibrations after they were taken.

python benchmarks/remedies.py                  # 52 rigs, of four kinds
python benchmarks/remedies.py --seeds 200 220  # others

Rigs of model_error_rigs.py with few captures, so that sensors are weak. Each remedy of each of them is taken:
boards are held again near those recorded (5 cm, 5 degrees), a suggested board is held, and uncertainties in
rig.yaml become what the remedy states that a measurement leaves. ``obtained/predicted``: the standard deviation
that the next calibration states over the predicted one, along the axis that the remedy names.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calgraph.config import Board, Rig, SensorSpec
from calgraph.geometry import Array, se3
from calgraph.result import Calibration, Remedy
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.sensors.kinds import KINDS
from calgraph.simulation import World
from calgraph.simulation.motion import BoardPlacement, SimulatedHold, pose_from_placement
from ideal_detections import simulate_detections
from model_error_rigs import SCENARIOS, rig_world
from model_errors import with_captures
from rig_errors import BoardErrors, ModelErrors
from worlds import NAN, Layout, grouped, make_parser, mean, median, run_worlds

CAPTURES = {"five": 10, "chain": 20, "pair": 10, "cameras": 16}
"""Of each kind of rig, with which some of its sensors are weak."""
BIASED = ModelErrors(BoardErrors(tremor=0.0015))
"""Displacements of the board in each message, m, of the size of view biases of real boards: without, more captures
show that views have no bias, which few cannot."""
NEAR = np.repeat([0.05, np.radians(5.0)], 3)
"""Standard deviations of captures like others: displacement of the board, m, and rotation, rad."""


@dataclass(frozen=True)
class Row:
    """One remedy of one sensor."""

    rig: str
    seed: int
    remedy: str = ""
    """``captures``, ``board``, ``print``, ``camera``, ``ranges``, or two of these; nothing if none is weak."""
    sensor: str = ""
    axis: str = ""
    before: float = NAN
    """Standard deviation, mm or degrees,"""
    predicted: float = NAN
    """and after the remedy: as predicted,"""
    obtained: float = NAN
    """and as the next calibration states it."""
    promised: bool = False
    """Whether the remedy was predicted to suffice,"""
    good: bool = False
    """and whether the sensor was good after it."""


def main() -> None:
    """Prints a table by remedy, and all together."""
    parser = make_parser(__doc__, jobs=2)
    parser.add_argument("--rigs", nargs="+", choices=list(SCENARIOS), default=list(SCENARIOS))
    parser.add_argument("--seeds", nargs=2, type=int, default=[100, 113], help="first, and one past the last")
    arguments = parser.parse_args()
    work = [(rig, seed) for rig in arguments.rigs for seed in range(*arguments.seeds)]
    rows = [row for row in run_worlds(Row, run, work, arguments, key=2) if row.remedy]
    table = Layout(
        "remedy:16 sensors:7d before:8.2f obtained/predicted:18.3f 5_%:6.2f 95_%:6.2f in_0.75_to_1.33:15.1% "
        "suffices:8d good:5d"
    )
    print(table.head)
    for remedy, group in [*grouped(rows, lambda row: row.remedy), ("all", rows)]:
        ratio = np.array([row.obtained / row.predicted for row in group])
        inside = mean([0.75 <= one <= 1.33 for one in ratio.tolist()])
        promised = [row for row in group if row.promised]
        print(
            table.line(
                remedy, len(group), median([row.before for row in group]), median(ratio),
                *np.quantile(ratio, [0.05, 0.95]), inside, len(promised), sum(row.good for row in promised),
            )
        )  # fmt: skip


def run(rig: str, seed: int) -> Sequence[Row]:
    """Calibrates a rig with few captures, and again after each remedy."""
    world, rng = rig_world(rig, seed), np.random.default_rng((seed, 36))
    world = with_captures(world, CAPTURES[rig], rng)
    description, captured, truth = simulate_detections(world, seed, None, BIASED)
    before = solve(description, captured, seed)
    T_world_root = next(s for s in world.robot if s.name == truth.root).T_world_sensor
    recorded = [pose_from_placement(hold.placement) for hold in world.trajectory.holds]
    taken: dict[str, Calibration] = {}
    rows = []
    for remedy in before.evidence.remedies:
        if remedy.action not in taken:
            near = [recorded[i % len(recorded)] for i in range(remedy.captures)]
            boards = [se3.retract(T, NEAR * rng.standard_normal(6)) for T in near]
            if remedy.T_root_board is not None:
                boards.append(T_world_root @ remedy.T_root_board)
            _, more, _ = simulate_detections(hold_boards(world, boards), seed, None, BIASED)
            taken[remedy.action] = solve(state_uncertainty(description, remedy), more, seed)
        rows.append(compare(rig, seed, remedy, taken[remedy.action]))
    return rows or [Row(rig, seed)]


def solve(rig: Rig, captured: CaptureSet, seed: int) -> Calibration:
    """The default calibration of some detections."""
    return solve_problem(build_problem_from_captures(rig, captured, RigOptions(), np.random.default_rng(seed)))


def hold_boards(world: World, T_world_boards: Sequence[Array]) -> World:
    """The world with further holds of the board."""
    trajectory = world.trajectory
    holds, times, placements = list(trajectory.holds), trajectory.times.tolist(), list(trajectory.placements)
    for T_world_board in T_world_boards:
        placement, start = place_board(T_world_board), times[-1] + 1.0
        holds.append(SimulatedHold(start, start + 2.0, placement))
        times += [start, start + 2.0]
        placements += [placement, placement]
    extended = replace(
        trajectory, times=np.array(times), placements=tuple(placements), holds=tuple(holds), end=times[-1]
    )
    return replace(world, trajectory=extended)


def place_board(T_world_board: Array) -> BoardPlacement:
    """The placement that :func:`pose_from_placement` gives this pose."""
    x, y, z = T_world_board[:3, 3].tolist()
    placement = BoardPlacement(float(np.arctan2(y, x)), float(np.hypot(x, y)), z, np.eye(3))
    R_world_facing = pose_from_placement(placement)[:3, :3]
    return replace(placement, R_facing_board=R_world_facing.T @ T_world_board[:3, :3])


def state_uncertainty(rig: Rig, remedy: Remedy) -> Rig:
    """The rig with the uncertainties that a remedy leaves."""

    def known(part: SensorSpec | Board, of: str) -> SensorSpec | Board:
        uncertainty: Any = part.uncertainty.model_copy(update=dict(remedy.uncertainty.get(of, {})))
        return part.model_copy(update={"uncertainty": uncertainty})

    sensors = {name: known(spec, name) for name, spec in rig.sensors.items()}
    return rig.model_copy(update={"sensors": sensors, "target": known(rig.boards[0], "board")})


def compare(rig: str, seed: int, remedy: Remedy, after: Calibration) -> Row:
    """Predicted and obtained standard deviations."""
    sensor = after[remedy.sensor]
    axis = KINDS[sensor.kind].axes.index(remedy.axis)
    scale = 1000 if remedy.unit == "m" else np.degrees(1)
    obtained = float(sensor.axis_stddev[axis])
    return Row(
        rig, seed, kind_of(remedy), sensor.name, remedy.axis, scale * remedy.stddev, scale * remedy.expected,
        scale * obtained, remedy.suffices, sensor.verdict.grade == "good",
    )  # fmt: skip


def kind_of(remedy: Remedy) -> str:
    """What a remedy consists of."""
    keys = {key for known in remedy.uncertainty.values() for key in known}
    parts = {
        "captures": remedy.captures > 0,
        "board": remedy.T_root_board is not None,
        "print": any(key.startswith(("print", "tag", "size", "bow")) for key in keys),
        "camera": "focal_length" in keys,
        "ranges": bool({"range_bias", "range_scale"} & keys),
    }
    return " + ".join(part for part, there in parts.items() if there)


if __name__ == "__main__":
    main()
