"""Calibrations of 3-D LiDARs in halls with people: errors, NEES, verdicts, time, memory, confidently wrong ones.

python benchmarks/lidar_networks.py --seeds 0 12 --jobs 2 --csv halls.csv        # resumed from the file
python benchmarks/lidar_networks.py --rigs 16_rings mixed --duration 30          # other sensors, shorter
python benchmarks/lidar_networks.py --kinds wrong --seeds 0 13 --verbose         # a line for each sensor

Kinds are those of lidar_network_kinds.py, simulated in memory with bodies and rooms that the estimator does not
know. A row is one sensor besides the root, as in drives.py, which states what is *confidently wrong*. Poses are
compared with those at the end, where a sensor was bumped, and with those in the middle, where one swings. The
scale is that of the positions of all sensors about their mean, over the true ones; the table has mean and spread
over networks, per mille. A network is connected if all of its sensors have poses. Errors in the plan are of x, y
and yaw, which 2-D scanners of mixed networks show; their heights and tilts are named as not observable.
"""

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.linalg import LinAlgError

from calgraph.config import Tolerance
from calgraph.errors import CalgraphError
from calgraph.geometry import Array, se3
from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import calibrate_network
from calgraph.simulation import simulate_hall
from drives import Outcome, Truth, judge, read_peak, reset_peak, show_each
from lidar_network_kinds import KINDS, RIGS, WRONG, build_hall_scenario
from worlds import NAN, Layout, finite, grouped, make_parser, mean, median, run_worlds, share, worst

TABLE = Layout(
    "kind:14 rig:12 nets:4d conn:4d good:4d weak:4d unob:4d none:4d mm:7.1f max:7.1f deg:6.3f max:6.3f "
    "plan:6.1f max:6.1f yaw:6.3f max:6.3f clock:6.2f max_ms:6.1f scale:6.2f std:5.2f "
    "NEES:6.2f trans:6.2f rot:6.2f out:4d conf:4d CPU_s:6.1f GB:5.2f"
)
ERRORS = (CalgraphError, ArithmeticError, LinAlgError, LookupError, ValueError)
"""Of a calibration that fails."""


@dataclass(frozen=True)
class NetworkOutcome(Outcome):
    """Of one sensor of one network, the root left out."""

    scale: float = NAN
    """Of the network over the true one, less 1."""
    plan_millimetres: float = NAN
    """Error in the plan, and about the vertical."""
    yaw_degrees: float = NAN


def main() -> None:
    """Prints a table by kind and rig, what is confidently wrong, and all reasons."""
    parser = make_parser(__doc__, jobs=2)
    parser.add_argument("--kinds", nargs="+", choices=[*KINDS, "wrong"], default=["ordinary"])
    parser.add_argument("--rigs", nargs="+", choices=list(RIGS), default=["32_rings"])
    parser.add_argument("--seeds", nargs=2, type=int, default=[0, 8], help="first, and one past the last")
    parser.add_argument("--duration", type=float, default=60.0, help="s")
    parser.add_argument("--tolerance", nargs=2, type=float, default=[0.02, 0.3], help="m, degrees")
    parser.add_argument("--verbose", action="store_true", help="a line for each sensor")
    arguments = parser.parse_args()
    kinds = dict.fromkeys(one for kind in arguments.kinds for one in (WRONG if kind == "wrong" else [kind]))
    work = [
        (kind, rig, seed, arguments.duration, tuple(arguments.tolerance))
        for kind in kinds
        for rig in arguments.rigs
        for seed in range(*arguments.seeds)
    ]
    outcomes = run_worlds(NetworkOutcome, run, work, arguments, key=4)
    print(f"{os.cpu_count()} processors\n")
    if arguments.verbose:
        show_each(outcomes)
    show(outcomes)


def run(kind: str, rig: str, seed: int, duration: float, tolerance: tuple[float, ...]) -> list[NetworkOutcome]:
    """Simulates and calibrates one network."""
    began = time.process_time()
    hall = simulate_hall(build_hall_scenario(kind, seed, rig, duration))
    metres, degrees = tolerance
    stated = hall.rig.model_copy(update={"tolerance": Tolerance(translation=metres, rotation=degrees)})
    truth = Truth(hall.truth.T_root_sensor, hall.truth.clock_offsets)
    first = NetworkOutcome(kind, rig, seed, duration, "", simulated_seconds=time.process_time() - began)
    reset_peak()
    began = time.process_time()
    try:
        found = calibrate_network(stated, hall.recording, NetworkOptions(seed=seed))
    except ERRORS as error:
        text = f"{type(error).__name__}: {error}"
        seconds = time.process_time() - began
        return [replace(first, crashed=not isinstance(error, CalgraphError), seconds=seconds, text=text)]
    poses = {one.name: one.T_root_sensor for one in found.sensors}
    rows = [judge(replace(first, sensor=name), found, truth) for name in stated.sensors if name != found.root]
    rows = [measure_plan(row, poses, truth, hall.truth.T_world_root) for row in rows]
    scale = measure_scale(poses, truth.T_root_sensor)
    seconds, peak = time.process_time() - began, read_peak()
    return [replace(row, seconds=seconds, gigabytes=peak, scale=scale) for row in rows]


def measure_plan(
    row: NetworkOutcome, poses: Mapping[str, Array], truth: Truth, T_world_root: Array
) -> NetworkOutcome:
    """The row of a sensor with its errors in the plan."""
    if row.sensor not in poses:
        return row
    error = se3.difference(poses[row.sensor], truth.T_root_sensor[row.sensor])
    shift, turn = (T_world_root[:3, :3] @ part for part in (error[:3], error[3:]))
    return replace(
        row, plan_millimetres=1000 * float(np.hypot(*shift[:2])), yaw_degrees=float(np.degrees(abs(turn[2])))
    )


def measure_scale(poses: Mapping[str, Array], true: Mapping[str, Array]) -> float:
    """Size of a network over the true one, less 1; NaN for less than two sensors."""
    if len(poses) < 2:
        return NAN
    spread, true_spread = (
        np.linalg.norm(places - places.mean(axis=0))
        for places in (np.array([one[name][:3, 3] for name in poses]) for one in (poses, true))
    )
    return float(spread / true_spread - 1)


def show(outcomes: Sequence[NetworkOutcome]) -> None:
    """Prints the table, each sensor that is confidently wrong, failures, and all reasons."""
    print(TABLE.head)
    groups = grouped(outcomes, lambda one: (one.kind, one.rig))
    for label, group in groups:
        show_line(label, group)
    if len(groups) > 1:
        show_line(("all", ""), outcomes)
    good = [one for one in outcomes if one.grade == "good"]
    confident = [one for one in outcomes if one.confidently_wrong]
    print(f"\nconfidently wrong: {len(confident)} of {len(good)} good sensors ({share(confident, good)}):")
    for one in confident:
        print(
            f"    {one.kind} {one.rig} seed {one.seed} {one.sensor}: {one.millimetres:.1f} mm, "
            f"{one.degrees:.3f} deg, NEES {one.nees:.1f}"
        )
    print("\nreasons and remarks, by kind, without numbers:")
    texts = [(one.kind, clause.strip()) for one in outcomes for clause in one.text.split("|") if clause.strip()]
    without = [(kind, "".join("#" if c.isdigit() else c for c in text), text) for kind, text in texts]
    for _, same in grouped(without, lambda one: one[:2]):
        print(f"    {same[0][0]:14} {len(same):3d} x {same[0][2][:240]}")
    simulated = finite([group[0].simulated_seconds for group in _networks(outcomes)])
    if len(simulated):
        print(f"\nsimulation: {simulated.mean():.1f} s of CPU a network, at most {simulated.max():.1f} s")


def _networks(outcomes: Sequence[NetworkOutcome]) -> list[list[NetworkOutcome]]:
    return [group for _, group in grouped(outcomes, lambda one: (one.kind, one.rig, one.seed))]


def show_line(label: tuple[str, str], group: Sequence[NetworkOutcome]) -> None:
    """Prints figures of some sensors: medians and largest errors, means of NEES of poses that are observable."""
    networks = _networks(group)
    counts = [sum(one.grade == grade for one in group) for grade in ("good", "weak", "unobservable", "none")]
    posed = [one for one in group if one.grade in ("good", "weak")]
    scales = 1000 * finite([some[0].scale for some in networks])
    clocks = np.abs([one.clock_milliseconds for one in group])
    print(
        TABLE.line(
            *label, len(networks), sum(all(one.grade != "none" for one in some) for some in networks), *counts,
            median([one.millimetres for one in group]), worst([one.millimetres for one in group]),
            median([one.degrees for one in group]), worst([one.degrees for one in group]),
            median([one.plan_millimetres for one in group]), worst([one.plan_millimetres for one in group]),
            median([one.yaw_degrees for one in group]), worst([one.yaw_degrees for one in group]),
            median(clocks), worst(clocks),
            mean(scales), float(scales.std()) if len(scales) else NAN,
            mean([one.nees for one in posed]), mean([one.nees_translation for one in posed]),
            mean([one.nees_rotation for one in posed]),
            sum(one.outside for one in group), sum(one.confidently_wrong for one in group),
            mean([some[0].seconds for some in networks]), worst([some[0].gigabytes for some in networks]),
        )
    )  # fmt: skip


if __name__ == "__main__":
    main()
