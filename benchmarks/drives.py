"""Calibrations from drives: errors, NEES, verdicts, time and memory, and results that are confidently wrong.

python benchmarks/drives.py --kinds ordinary --seeds 0 24 --jobs 2 --csv drives.csv   # resumed from the file
python benchmarks/drives.py --rigs four_lidars --duration 30                          # other sensors, shorter
python benchmarks/drives.py --kinds wrong --seeds 0 10 --verbose                      # a line for each sensor
python benchmarks/drives.py --real --tolerance 0.02 0.5 --csv real.csv                # the recording fr079

Kinds are those of drive_kinds.py, simulated in memory. A row is one sensor besides the root; judged_sensors.py
states what its columns are, and what is *confidently wrong*. The pose is compared with the one at the end of the
drive, where a sensor was bumped.

The real recording is fr079 of Radish, a scanner of 180 degrees on a robot in an office. Its beams right and left
of straight ahead are taken as two scanners that share no view, the second in another frame and by another clock,
which are known exactly. Windows are a minute each, the first starts after 30 s. The halves of a scan are 3 ms
apart, so that clocks are known to 4 ms only.

Audits: poses that are good are compared, as ``calgraph check`` compares them, with the true ones (false alarms)
and with ones that are moved by 5, 20 and 50 mm and a hundredth of that number in degrees, in 32 directions each.
"""

import bz2
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calgraph.config import Rig, Tolerance
from calgraph.drive.options import DriveOptions
from calgraph.drive.pipeline import calibrate_drive
from calgraph.geometry import Array, se2
from calgraph.recording import MessageRecording
from calgraph.sensors import LaserScan
from calgraph.simulation import STANDARD_RIGS, simulate_drive
from calgraph.simulation.drive_scenario import RANGING
from drive_kinds import KINDS, build_drive_scenario
from judged_sensors import Outcome, Truth, judge, list_worlds, make_judging_parser, measure, show_outcomes
from worlds import mean, run_worlds, share

WINDOWS, WINDOW, FIRST_WINDOW = 15, 60.0, 30.0
"""Of the real recording: number, length, and start of the first, s."""
REAL_FRAMES: Mapping[str, tuple[float, float, float, float]] = {
    "front": (0.35, -0.22, 137.5, 0.083),
    "rear": (-0.6, 0.4, -75.0, -0.14),
    "left": (0.0, 0.9, 20.0, 0.3),
}
"""By name: x, y (m) and yaw (degrees) of the second scanner in the frame of the first; its clock minus that, s."""
REAL_PATH = Path("radish-fr079-2d-laser-odometry", "fr079.clf.bz2")
FEW_SURFACES = "walls that it measured agree"
"""In the reason of a verdict: fewer than 30 cells."""
WRONG = tuple(
    kind for kind in KINDS if kind not in ("ordinary", "planar", "clocks_half_a_second", "corridor_both_ways")
)
"""The kinds that determine too little, or in which something is wrong."""
REAL_MAX_RANGE = 40.0
"""Larger ranges are no returns, m."""


class Setup(NamedTuple):
    """What all runs share."""

    tolerance: tuple[float, ...]
    """m, degrees."""
    data: str
    """Folder of the real recording."""


def main() -> None:
    """Prints a table by kind and rig, what is confidently wrong, and all reasons."""
    parser = make_judging_parser(__doc__, list(KINDS), list(KINDS), list(STANDARD_RIGS), (0.01, 0.3))
    parser.add_argument("--real", action="store_true", help="windows of the real recording, by seed")
    parser.add_argument("--frames", nargs="+", choices=list(REAL_FRAMES), default=list(REAL_FRAMES))
    parser.add_argument("--data", default=os.environ.get("CALGRAPH_DATA", "data"), help="folder of recordings")
    arguments = parser.parse_args()
    setup = Setup(tuple(arguments.tolerance), arguments.data)
    work = list_worlds(arguments, WRONG, setup)
    if arguments.real:
        windows = range(WINDOWS) if arguments.seeds == [0, 8] else range(*arguments.seeds)
        work = [("real", frame, seed, WINDOW, setup) for frame in arguments.frames for seed in windows]
    outcomes = run_worlds(Outcome, run, work, arguments, key=4)
    show_outcomes(outcomes, arguments.verbose)
    show_audits(outcomes)


def run(kind: str, rig: str, seed: int, duration: float, setup: Setup) -> list[Outcome]:
    """Simulates, or reads, and calibrates one drive."""
    began = time.process_time()
    if kind == "real":
        recording, truth, kinds = read_window(Path(setup.data) / REAL_PATH, seed, rig)
    else:
        drive = simulate_drive(build_drive_scenario(kind, seed, rig, duration))  # type: ignore[arg-type]
        recording, truth = drive.recording, Truth(drive.truth.T_root_sensor_after, drive.truth.clock_offsets)
        kinds = {
            one.name: "lidar2d" if one.kind == "scanner" else "lidar3d"
            for one in drive.scenario.sensors
            if one.kind in RANGING
        }
    stated = describe_rig(kinds, setup.tolerance)
    first = Outcome(kind, rig, seed, duration, "", simulated_seconds=time.process_time() - began)
    row, found = measure(first, lambda: calibrate_drive(stated, recording, DriveOptions(seed=seed)))
    if found is None:
        return [row]
    return [judge(replace(row, sensor=name), found, truth) for name in kinds if name != found.root]


_TOPICS = {"lidar2d": "scan", "trajectory": "odometry"}


def describe_rig(kinds: Mapping[str, str], tolerance: tuple[float, ...]) -> Rig:
    """rig.yaml of sensors by kind, the first of which is the root."""
    sensors = {
        name: {"kind": kind, "topic": f"/{name}/{_TOPICS.get(kind, 'points')}"} for name, kind in kinds.items()
    }
    rig = Rig.model_validate({"root": next(iter(kinds)), "target": {"kind": "surroundings"}, "sensors": sensors})
    metres, degrees = tolerance
    return rig.model_copy(update={"tolerance": Tolerance(translation=metres, rotation=degrees)})


@cache
def read_scans(path: Path) -> tuple[Array, Array]:
    """Stamps (N,), s, and ranges (N, 360), m, of a log of CARMEN; infinite where nothing returned.

    A line is ``FLASER count ranges… x y theta odom_x odom_y odom_theta stamp host logger_stamp``.
    """
    stamps, ranges = [], []
    with bz2.open(path, "rt", encoding="ascii") as file:
        for line in file:
            words = line.split()
            if words[:1] == ["FLASER"] and words[1] == "360":
                ranges.append(np.array(words[2:362], dtype=np.float64))
                stamps.append(float(words[362 + 6]))
    measured = np.array(ranges)
    return np.array(stamps), np.where(measured < REAL_MAX_RANGE, measured, np.inf)


def read_window(path: Path, window: int, frame: str) -> tuple[MessageRecording, Truth, dict[str, str]]:
    """A minute of the real recording as that of two scanners, with the ground truth and their kinds."""
    stamps, ranges = read_scans(path)
    start = stamps[0] + FIRST_WINDOW + WINDOW * window
    inside = np.flatnonzero((stamps >= start) & (stamps < start + WINDOW))
    x, y, yaw, clock = REAL_FRAMES[frame]
    T_root_left = se2.pose(np.radians(yaw), np.array([x, y]))
    T_left_root = se2.inverse(T_root_left)
    bearings = np.radians(-90 + 0.5 * np.arange(360))
    directions = np.stack([np.cos(bearings[180:]), np.sin(bearings[180:])], axis=1)
    messages: dict[str, list[LaserScan]] = {"/right/scan": [], "/left/scan": []}
    for stamp, measured in zip(stamps[inside], ranges[inside], strict=True):
        messages["/right/scan"].append(LaserScan(float(stamp), "right", bearings[:180], measured[:180]))
        # Beams without a return stay, at some place of theirs, so that others keep their numbers.
        hit = np.isfinite(measured[180:])
        ends = se2.apply(T_left_root, np.where(hit, measured[180:], 1.0)[:, None] * directions)
        angles, lengths = np.arctan2(ends[:, 1], ends[:, 0]), np.where(hit, np.hypot(*ends.T), np.inf)
        messages["/left/scan"].append(LaserScan(float(stamp + clock), "left", angles, lengths))
    truth = Truth({"right": np.eye(4), "left": se2.to_se3(T_root_left)}, {"right": 0.0, "left": clock})
    return MessageRecording(messages), truth, {"right": "lidar2d", "left": "lidar2d"}


def show_audits(outcomes: Sequence[Outcome]) -> None:
    """Prints what audits of good poses find, and verdicts of sensors that have enough surfaces in common."""
    good = [one for one in outcomes if one.grade == "good"]
    found = ", ".join(f"{mean([getattr(one, f'found_{n}') for one in good]):.0%} of {n} mm" for n in (5, 20, 50))
    print(f"audits: {mean([one.false_alarm for one in good]):.0%} false alarms; moves found: {found}")
    enough = [one for one in outcomes if one.sensor and FEW_SURFACES not in one.text]
    print(f"with enough common surfaces: {len(enough)} sensors, good {share(good, enough)}")


if __name__ == "__main__":
    main()
