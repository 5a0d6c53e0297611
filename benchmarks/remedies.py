"""Remedies that a calibration states, against calibrations after they were taken.

python benchmarks/remedies.py                  # 52 rigs, of four kinds
python benchmarks/remedies.py --seeds 200 220  # others
python benchmarks/remedies.py --networks       # 63 networks, of three rooms

Rigs of model_error_rigs.py with few captures, so that sensors are weak. Each remedy of each of them is taken:
boards are held again near those recorded (5 cm, 5 degrees), a suggested board is held, and uncertainties in
rig.yaml become what the remedy states that a measurement leaves. ``obtained/predicted``: the standard deviation
that the next calibration states over the predicted one, along the axis that the remedy names.

Systematic errors of a network's scanners are drawn with all of the prior's standard deviation or with a part of
it, and the tolerance is such that scanners are weak. The errors of compared scanners become those that a
comparison leaves. Where they are small, in recordings of a minute instead of 20 s, the same people walk longer.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calgraph.config import Board, Lidar2dUncertainty, Rig, SensorSpec, Tolerance
from calgraph.geometry import Array, se3
from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import calibrate_tracks
from calgraph.result import Calibration, Remedy
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.sensors.kinds import KINDS
from calgraph.simulation import World, build_network, network_rig, simulate_scans
from calgraph.simulation.motion import BoardPlacement, SimulatedHold, pose_from_placement
from calgraph.simulation.network_scanners import StationaryScanner
from ideal_detections import simulate_detections
from model_error_rigs import SCENARIOS, rig_world
from model_errors import with_captures
from network_model_error_kinds import ROOMS, build_scenario
from network_runs import track_scanners
from rig_errors import BoardErrors, ModelErrors
from worlds import NAN, Layout, grouped, make_parser, mean, median, run_worlds

CAPTURES = {"five": 10, "chain": 20, "pair": 10, "cameras": 16}
"""Of each kind of rig, with which some of its sensors are weak."""
BIASED = ModelErrors(BoardErrors(tremor=0.0015))
"""Displacements of the board in each message, m, of the size of view biases of real boards: without, more captures
show that views have no bias, which few cannot."""
NEAR = np.repeat([0.05, np.radians(5.0)], 3)
"""Standard deviations of captures like others: displacement of the board, m, and rotation, rad."""

NETWORKS = {
    f"{room} {share:g}": (seconds, Tolerance(translation=tolerance, rotation=0.1))
    for share, seconds, tolerance in ((1 / 16, 60.0, 0.002), (0.25, 20.0, 0.005), (1.0, 20.0, 0.01))
    for room in ROOMS
}
"""By room and share of the systematic errors' priors that is drawn: duration, s, and tolerance."""
LONG = 60.0
"""Duration of recordings of which only longer ones are taken, s: the others take as long as a calibration each."""


@dataclass(frozen=True)
class Row:
    """One remedy of one sensor."""

    rig: str
    seed: int
    remedy: str = ""
    """``captures``, ``board``, ``print``, ``camera``, ``ranges``, ``longer``, or two of these; nothing if none is
    weak."""
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
    parser.add_argument("--networks", action="store_true", help="of 2-D scanners, instead of rigs")
    parser.add_argument("--seeds", nargs=2, type=int, help="first, and one past the last")
    arguments = parser.parse_args()
    first, end = arguments.seeds or ([100, 107] if arguments.networks else [100, 113])
    kinds = NETWORKS if arguments.networks else arguments.rigs
    function = run_network if arguments.networks else run
    work = [(kind, seed) for kind in kinds for seed in range(first, end)]
    rows = [row for row in run_worlds(Row, function, work, arguments, key=2) if row.remedy]
    table = Layout(
        "remedy:18 sensors:7d before:8.2f obtained/predicted:18.3f 5_%:6.2f 95_%:6.2f in_0.75_to_1.33:15.1% "
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


def run_network(kind: str, seed: int) -> Sequence[Row]:
    """Calibrates a network, and again after each remedy."""
    before = solve_network(kind, seed)
    taken: dict[str, Calibration] = {}
    rows = []
    for remedy in before.evidence.remedies:
        if NETWORKS[kind][0] == LONG and not remedy.duration:
            continue
        if remedy.action not in taken:
            taken[remedy.action] = solve_network(kind, seed, remedy)
        rows.append(compare(kind, seed, remedy, taken[remedy.action]))
    return rows or [Row(kind, seed)]


def solve_network(kind: str, seed: int, remedy: Remedy | None = None) -> Calibration:
    """The default calibration of a network, after a remedy."""
    (room, share), (seconds, tolerance) = kind.split(), NETWORKS[kind]
    duration = seconds + (remedy.duration if remedy else 0.0)
    network = build_network(build_scenario(room, "drawn", float(share), duration, "ellipse"), seed)
    rig = network_rig(network).model_copy(update={"tolerance": tolerance})
    if remedy:
        scanners = [correct_ranges(one, remedy, float(share)) for one in network.scanners]
        network, rig = replace(network, scanners=tuple(scanners)), state_uncertainty(rig, remedy)
    scans = {one.name: list(simulate_scans(network, one)) for one in network.scanners}
    return calibrate_tracks(rig, track_scanners(rig, scans, "nls"), NetworkOptions(seed=seed))


def correct_ranges(scanner: StationaryScanner, remedy: Remedy, share: float) -> StationaryScanner:
    """A scanner whose ranges are corrected by what a comparison found, which leaves errors of the stated size."""
    drawn, left = Lidar2dUncertainty(), remedy.uncertainty.get(scanner.name, {})
    errors = {key: getattr(scanner, key) * min(left[key] / (share * getattr(drawn, key)), 1.0) for key in left}
    return replace(scanner, **errors)


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

    sensors: dict[str, Any] = {name: known(spec, name) for name, spec in rig.sensors.items()}
    target = rig.target if rig.is_network else known(rig.boards[0], "board")
    return rig.model_copy(update={"sensors": sensors, "target": target})


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
        "longer": remedy.duration > 0,
        "board": remedy.T_root_board is not None,
        "print": any(key.startswith(("print", "tag", "size", "bow")) for key in keys),
        "camera": "focal_length" in keys,
        "ranges": bool({"range_bias", "range_scale"} & keys),
    }
    return " + ".join(part for part, there in parts.items() if there)


if __name__ == "__main__":
    main()
