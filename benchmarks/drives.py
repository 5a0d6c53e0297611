"""Calibrations from drives: errors, NEES, verdicts, time and memory, and results that are confidently wrong.

python benchmarks/drives.py --kinds ordinary --seeds 0 24 --jobs 2 --csv drives.csv   # resumed from the file
python benchmarks/drives.py --rigs four_lidars --duration 30                          # other sensors, shorter
python benchmarks/drives.py --kinds wrong --seeds 0 10 --verbose                      # a line for each sensor
python benchmarks/drives.py --real --tolerance 0.02 0.5 --csv real.csv                # the recording fr079

Kinds are those of drive_kinds.py, simulated in memory. A row is one sensor besides the root. A sensor is
*confidently wrong* if its verdict is good and its pose is outside of the 99.9 % ellipsoid of its covariance by
more than 5 mm or 0.1 degrees, or more than 50 mm or 1 degree off; ``out`` counts those outside with any verdict.
The pose is compared with the one at the end of the drive, where a sensor was bumped. NEES is per degree of
freedom, of the axes that were measured: of the pose, of its translation, and of its rotation.

The real recording is fr079 of Radish, a scanner of 180 degrees on a robot in an office. Its beams right and left
of straight ahead are taken as two scanners that share no view, the second in another frame and by another clock,
which are known exactly. Windows are a minute each, the first starts after 30 s. The halves of a scan are 3 ms
apart, so that clocks are known to 4 ms only.

Audits: poses that are good are compared, as ``calgraph check`` compares them, with the true ones (false alarms)
and with ones that are moved by 5, 20 and 50 mm and a hundredth of that number in degrees, in 32 directions each.
"""

import bz2
import os
import resource
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.linalg import LinAlgError
from scipy.stats import chi2

from calgraph.config import Rig, Tolerance
from calgraph.config.settings import VerdictSettings
from calgraph.drive.options import DriveOptions
from calgraph.drive.pipeline import calibrate_drive
from calgraph.errors import CalgraphError
from calgraph.geometry import Array, Index, se2, se3
from calgraph.recording import MessageRecording
from calgraph.result import Calibration
from calgraph.sensors import LaserScan
from calgraph.simulation import STANDARD_RIGS, simulate_drive
from calgraph.simulation.drive_scenario import RANGING
from calgraph.verdict.comparison import SignificanceTest
from drive_kinds import KINDS, build_drive_scenario
from worlds import NAN, Layout, finite, grouped, make_parser, mean, median, run_worlds, share, worst

TABLE = Layout(
    "kind:20 rig:14 drives:6d start:5d good:4d weak:4d unob:4d none:4d mm:7.1f max:7.0f deg:6.3f max:6.2f "
    "clock:6.2f max_ms:6.1f NEES:6.2f trans:6.2f rot:6.2f out:4d conf:4d CPU_s:6.1f GB:5.2f"
)
MAX_METRES, MAX_DEGREES = 0.005, 0.1
"""By which a good pose may be outside of its ellipsoid."""
FAR_METRES, FAR_DEGREES = 0.05, 1.0
"""By which a good pose may be off in any case."""
ELLIPSOID = 0.999
"""Probability of the ellipsoid."""
MOVES = (0.0, 0.005, 0.02, 0.05)
"""Sizes of moves that audits should find, m; 0 is none."""
DEGREES_PER_METRE = 10.0
"""By which sensors turn as well."""
DIRECTIONS = 32
"""Of each move."""
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


@dataclass(frozen=True)
class Outcome:
    """Of one sensor of one drive, the root left out."""

    kind: str
    rig: str
    seed: int
    duration: float
    """s."""
    sensor: str
    """Empty where the calibration failed, which counts as one sensor without a pose."""
    grade: str = "none"
    """Good, weak, unobservable; none where the sensor has no pose."""
    millimetres: float = NAN
    degrees: float = NAN
    clock_milliseconds: float = NAN
    """Error of the clock offset."""
    nees: float = NAN
    nees_translation: float = NAN
    nees_rotation: float = NAN
    stddev_millimetres: float = NAN
    """Largest standard deviation along an axis,"""
    stddev_degrees: float = NAN
    """and about one."""
    outside_millimetres: float = NAN
    """How far outside of the ellipsoid; 0 inside of it."""
    outside_degrees: float = NAN
    crashed: bool = False
    seconds: float = NAN
    """Processor time of the calibration."""
    simulated_seconds: float = NAN
    """And of the simulation."""
    gigabytes: float = NAN
    """Largest memory of the process during the calibration, with the messages."""
    false_alarm: float = NAN
    """Whether an audit finds that the sensor moved, which did not; of good poses,"""
    found_5: float = NAN
    found_20: float = NAN
    found_50: float = NAN
    """and the shares of moves by 5, 20 and 50 mm that it finds."""
    text: str = ""
    """Reason of the verdict or of its absence, and remarks."""

    @property
    def outside(self) -> bool:
        """Whether the pose is outside of its ellipsoid."""
        return self.outside_millimetres > 1000 * MAX_METRES or self.outside_degrees > MAX_DEGREES

    @property
    def confidently_wrong(self) -> bool:
        """Whether the verdict is good and the pose is outside of its ellipsoid, or far off."""
        far = self.millimetres > 1000 * FAR_METRES or self.degrees > FAR_DEGREES
        return self.grade == "good" and (self.outside or far)


class Truth(NamedTuple):
    """What a result is compared with."""

    T_root_sensor: Mapping[str, Array]
    """(4, 4)."""
    clock_offsets: Mapping[str, float]
    """s."""


class Setup(NamedTuple):
    """What all runs share."""

    tolerance: tuple[float, ...]
    """m, degrees."""
    data: str
    """Folder of the real recording."""


def main() -> None:
    """Prints a table by kind and rig, what is confidently wrong, and all reasons."""
    parser = make_parser(__doc__, jobs=2)
    parser.add_argument("--kinds", nargs="+", choices=[*KINDS, "wrong"], default=list(KINDS))
    parser.add_argument("--rigs", nargs="+", choices=list(STANDARD_RIGS), default=["two_lidars"])
    parser.add_argument("--seeds", nargs=2, type=int, default=[0, 8], help="first, and one past the last")
    parser.add_argument("--duration", type=float, default=60.0, help="s")
    parser.add_argument("--tolerance", nargs=2, type=float, default=[0.01, 0.3], help="m, degrees")
    parser.add_argument("--real", action="store_true", help="windows of the real recording, by seed")
    parser.add_argument("--frames", nargs="+", choices=list(REAL_FRAMES), default=list(REAL_FRAMES))
    parser.add_argument("--data", default=os.environ.get("CALGRAPH_DATA", "data"), help="folder of recordings")
    parser.add_argument("--verbose", action="store_true", help="a line for each sensor")
    arguments = parser.parse_args()
    setup = Setup(tuple(arguments.tolerance), arguments.data)
    if arguments.real:
        windows = range(WINDOWS) if arguments.seeds == [0, 8] else range(*arguments.seeds)
        work: list[tuple[Any, ...]] = [
            ("real", frame, seed, WINDOW, setup) for frame in arguments.frames for seed in windows
        ]
    else:
        work = [
            (kind, rig, seed, arguments.duration, setup)
            for kind in dict.fromkeys(
                one for kind in arguments.kinds for one in (WRONG if kind == "wrong" else [kind])
            )
            for rig in arguments.rigs
            for seed in range(*arguments.seeds)
        ]
    outcomes = run_worlds(Outcome, run, work, arguments, key=4)
    print(f"{_processor()}, {os.cpu_count()} processors\n")
    if arguments.verbose:
        show_each(outcomes)
    show(outcomes)


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
    reset_peak()
    began = time.process_time()
    try:
        found = calibrate_drive(stated, recording, DriveOptions(seed=seed))
    except (CalgraphError, ArithmeticError, LinAlgError, LookupError, ValueError) as error:
        text = f"{type(error).__name__}: {error}"
        seconds = time.process_time() - began
        return [replace(first, crashed=not isinstance(error, CalgraphError), seconds=seconds, text=text)]
    first = replace(first, seconds=time.process_time() - began, gigabytes=read_peak())
    return [judge(replace(first, sensor=name), found, truth) for name in kinds if name != found.root]


def describe_rig(kinds: Mapping[str, str], tolerance: tuple[float, ...]) -> Rig:
    """rig.yaml of sensors by kind, the first of which is the root."""
    sensors = {
        name: {"kind": kind, "topic": f"/{name}/{'scan' if kind == 'lidar2d' else 'points'}"}
        for name, kind in kinds.items()
    }
    rig = Rig.model_validate({"root": next(iter(kinds)), "target": {"kind": "surroundings"}, "sensors": sensors})
    metres, degrees = tolerance
    return rig.model_copy(update={"tolerance": Tolerance(translation=metres, rotation=degrees)})


Judged = TypeVar("Judged", bound=Outcome)


def judge(outcome: Judged, found: Calibration, truth: Truth) -> Judged:
    """Compares one sensor with the ground truth."""
    name, remarks = outcome.sensor, " | ".join(found.evidence.remarks)
    sensor = next((one for one in found.sensors if one.name == name), None)
    if sensor is None:
        return replace(outcome, text=f"{found.evidence.unconnected.get(name, '')} | {remarks}")
    error = se3.difference(sensor.T_root_sensor, truth.T_root_sensor[name])
    variances = np.diag(sensor.covariance)
    axes = np.flatnonzero(np.isfinite(variances) & (variances > 0))
    squared = _squared_distance(error, sensor.covariance, axes)
    limit = float(chi2.ppf(ELLIPSOID, max(len(axes), 1)))
    beyond = max(1 - np.sqrt(limit / squared), 0.0) if squared > 0 else 0.0
    known = np.zeros(6)
    known[axes] = error[axes]
    millimetres = 1000 * float(np.linalg.norm(known[:3]))
    degrees = float(np.degrees(np.linalg.norm(known[3:])))
    clock, (metres, radians) = sensor.clock_offset, sensor.worst_stddev
    translation, rotation = axes[axes < 3], axes[axes >= 3]
    good = sensor.verdict.grade == "good"
    audits = audit(error, sensor.covariance, axes, outcome.seed) if good else [NAN] * len(MOVES)
    return replace(
        outcome,
        grade=sensor.verdict.grade,
        millimetres=millimetres,
        degrees=degrees,
        clock_milliseconds=NAN if clock is None else 1000 * (clock - truth.clock_offsets[name]),
        nees=squared / max(len(axes), 1),
        nees_translation=_squared_distance(error, sensor.covariance, translation) / max(len(translation), 1),
        nees_rotation=_squared_distance(error, sensor.covariance, rotation) / max(len(rotation), 1),
        stddev_millimetres=1000 * metres,
        stddev_degrees=float(np.degrees(radians)),
        outside_millimetres=beyond * millimetres,
        outside_degrees=beyond * degrees,
        false_alarm=audits[0],
        found_5=audits[1],
        found_20=audits[2],
        found_50=audits[3],
        text=f"{sensor.verdict.reason} | {remarks}".strip(" |"),
    )


def audit(error: Array, covariance: Array, axes: Index, seed: int) -> list[float]:
    """Shares of the moves of each size that are significant beside the error (6,) of a pose."""
    rng = np.random.default_rng([seed, 7])
    limit = SignificanceTest.of(VerdictSettings().false_alarm_probability, len(axes)).max_chi2
    directions = np.zeros((DIRECTIONS, 6))
    directions[:, axes] = rng.normal(size=(DIRECTIONS, len(axes)))
    for block, unit in ((slice(0, 3), 1.0), (slice(3, 6), np.radians(DEGREES_PER_METRE))):
        directions[:, block] *= unit / np.linalg.norm(directions[:, block], axis=1, keepdims=True)
    return [
        float(np.mean([_squared_distance(error - size * one, covariance, axes) > limit for one in directions]))
        for size in MOVES
    ]


def _squared_distance(error: Array, covariance: Array, axes: Index) -> float:
    """Squared Mahalanobis distance along and about some axes."""
    part = error[axes]
    return float(part @ np.linalg.solve(covariance[np.ix_(axes, axes)], part)) if len(axes) else 0.0


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


def reset_peak() -> None:
    """Makes the largest memory of this process that of now, where the system has it."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def read_peak() -> float:
    """Largest memory of this process, GB."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 2**20
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def _processor() -> str:
    """The name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return "unknown processor"
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")


def show_each(outcomes: Sequence[Outcome]) -> None:
    """Prints a line for each sensor."""
    for one in outcomes:
        print(
            f"{one.kind:20} {one.rig:14} {one.seed:4d} {one.sensor:12} {one.grade:12} {one.millimetres:8.2f} mm "
            f"(σ {one.stddev_millimetres:.2f}) {one.degrees:7.3f} deg (σ {one.stddev_degrees:.3f}) "
            f"{one.clock_milliseconds:7.2f} ms NEES {one.nees:.2f} {one.text[:160]}"
        )


def show(outcomes: Sequence[Outcome]) -> None:
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
    if good:
        found = ", ".join(
            f"{mean([getattr(one, f'found_{n}') for one in good]):.0%} of {n} mm" for n in (5, 20, 50)
        )
        print(f"audits: {mean([one.false_alarm for one in good]):.0%} false alarms; moves found: {found}")
    enough = [one for one in outcomes if one.sensor and FEW_SURFACES not in one.text]
    print(f"with enough common surfaces: {len(enough)} sensors, good {share(good, enough)}")
    for one in outcomes:
        if not one.sensor:
            word = "crashed" if one.crashed else "failed"
            print(f"{word}: {one.kind} {one.rig} seed {one.seed}: {one.text[:200]}")
    print("\nreasons and remarks, by kind, without numbers:")
    texts = [(one.kind, clause.strip()) for one in outcomes for clause in one.text.split("|") if clause.strip()]
    for (kind, text), same in grouped(texts, lambda one: (one[0], _without_numbers(one[1]))):
        print(f"    {kind:20} {len(same):3d} x {text[:240]}")
    simulated = finite([group[0].simulated_seconds for _, group in _drives(outcomes)])
    if len(simulated):
        print(f"\nsimulation: {simulated.mean():.1f} s of CPU a drive, at most {simulated.max():.1f} s")


def _drives(outcomes: Sequence[Outcome]) -> list[tuple[tuple[str, str, int], list[Outcome]]]:
    return grouped(outcomes, lambda one: (one.kind, one.rig, one.seed))


def _without_numbers(text: str) -> str:
    return "".join("#" if c.isdigit() else c for c in text)


def show_line(label: tuple[str, str], group: Sequence[Outcome]) -> None:
    """Prints figures of some sensors: medians and largest errors, means of NEES of poses that are observable."""
    drives = [some for _, some in _drives(group)]
    counts = [sum(one.grade == grade for one in group) for grade in ("good", "weak", "unobservable", "none")]
    started = sum(all(one.grade != "none" for one in some) for some in drives)
    posed = [one for one in group if one.grade in ("good", "weak")]
    clocks = np.abs([one.clock_milliseconds for one in group])
    print(
        TABLE.line(
            *label, len(drives), started, *counts,
            median([one.millimetres for one in group]), worst([one.millimetres for one in group]),
            median([one.degrees for one in group]), worst([one.degrees for one in group]),
            median(clocks), worst(clocks),
            mean([one.nees for one in posed]), mean([one.nees_translation for one in posed]),
            mean([one.nees_rotation for one in posed]),
            sum(one.outside for one in group), sum(one.confidently_wrong for one in group),
            mean([some[0].seconds for some in drives]), worst([some[0].gigabytes for some in drives]),
        )
    )  # fmt: skip


if __name__ == "__main__":
    main()
