"""The frame of the vehicle from simulated drives, through the whole pipeline: errors by axis, and NEES.

python benchmarks/vehicle_frames.py --seeds 300 324 --jobs 2 --csv frames.csv   # resumed from the file
python benchmarks/vehicle_frames.py --rigs four_lidars --duration 60            # other sensors, longer
python benchmarks/vehicle_frames.py --rigs lidar_and_odometry                   # with wheels, which determine y

Errors are those of the root in the frame on the floor below the rear axle, along and about its axes. NEES is per
degree of freedom, of the axes that were measured: y with wheels only.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from calgraph.config.rig_config import Base
from calgraph.drive.options import DriveOptions
from calgraph.drive.pipeline import calibrate_drive
from calgraph.errors import CalgraphError
from calgraph.geometry import se3
from calgraph.simulation import STANDARD_RIGS, simulate_drive
from drive_kinds import build_drive_scenario
from drives import describe_rig
from worlds import NAN, finite, make_parser, run_worlds

KINDS = {"lidar": "lidar3d", "solid_state": "lidar3d", "odometry": "trajectory"}
"""Sensors in space that measure the floor, which 2-D scanners do not; and wheels."""
AXES = ("x", "y", "z", "roll", "pitch", "yaw")
"""Of the errors."""


@dataclass(frozen=True)
class Frame:
    """Of one drive: errors and standard deviations, mm and degrees."""

    rig: str
    seed: int
    duration: float
    """s."""
    x: float = NAN
    y: float = NAN
    z: float = NAN
    roll: float = NAN
    pitch: float = NAN
    yaw: float = NAN
    x_stddev: float = NAN
    y_stddev: float = NAN
    z_stddev: float = NAN
    roll_stddev: float = NAN
    pitch_stddev: float = NAN
    yaw_stddev: float = NAN
    nees: float = NAN
    grade: str = "none"
    y_is_null: bool = True
    text: str = ""


def main() -> None:
    """Prints a line for each drive, and figures by axis."""
    parser = make_parser(__doc__, jobs=2)
    rigs = [name for name, sensors in STANDARD_RIGS.items() if all(one.kind in KINDS for one in sensors)]
    parser.add_argument("--rigs", nargs="+", choices=rigs, default=["two_lidars"])
    parser.add_argument("--seeds", nargs=2, type=int, default=[300, 308], help="first, and one past the last")
    parser.add_argument("--duration", type=float, default=30.0, help="s")
    arguments = parser.parse_args()
    work: list[tuple[Any, ...]] = [
        (rig, seed, arguments.duration) for rig in arguments.rigs for seed in range(*arguments.seeds)
    ]
    frames = run_worlds(Frame, run, work, arguments, key=3)
    for one in frames:
        errors = " ".join(
            f"{axis} {getattr(one, axis):.{digits}f} (σ {getattr(one, axis + '_stddev'):.{digits}f})"
            for axis, digits in zip(AXES, (1, 1, 1, 3, 3, 3), strict=True)
        )
        print(f"{one.rig} {one.seed} {errors} NEES {one.nees:.2f} {one.grade} {one.text[:100]}")
    located = [one for one in frames if np.isfinite(one.nees)]
    count = sum(one.y_is_null for one in located)
    print(f"\n{len(located)} of {len(frames)} drives have a frame; y is null in {count}")
    for axis, unit in zip(AXES, ("mm", "mm", "mm", "°", "°", "°"), strict=True):
        found = finite([getattr(one, axis) for one in frames])
        if len(found):
            sizes = np.abs(found)
            print(
                f"{axis:6} mean {found.mean():7.3f}, RMS {np.sqrt(np.mean(found**2)):.3f}, "
                f"median size {np.median(sizes):.3f}, at most {sizes.max():.3f} {unit}"
            )
    distances = np.array([one.nees for one in located])
    print(f"NEES {distances.mean():.2f}, median {np.median(distances):.2f}, at most {distances.max():.2f}")


def run(rig: str, seed: int, duration: float) -> Frame:
    """Simulates a drive and calibrates it with a base frame."""
    drive = simulate_drive(build_drive_scenario("ordinary", seed, rig, duration))  # type: ignore[arg-type]
    stated = describe_rig({one.name: KINDS[one.kind] for one in drive.scenario.sensors}, (0.01, 0.3))
    wheels = [one.name for one in drive.scenario.sensors if one.kind == "odometry"]
    frame = Base(frame="base_link", axle="rear", wheels=wheels[0] if wheels else None)
    stated = stated.model_copy(update={"base": frame})
    try:
        base = calibrate_drive(stated, drive.recording, DriveOptions(seed=seed)).base
    except CalgraphError as failure:
        return Frame(rig, seed, duration, text=str(failure))
    assert base is not None
    variances = np.diag(base.covariance)
    known = np.flatnonzero(np.isfinite(variances))
    if not base.known or not len(known):
        return Frame(rig, seed, duration, text=base.verdict.reason)
    found = base.T_base_root.copy()
    y_is_null = bool(np.isnan(found[1, 3]))
    found[:3, 3] = np.where(np.isnan(found[:3, 3]), drive.truth.T_base_root[:3, 3], found[:3, 3])
    error = se3.difference(found, drive.truth.T_base_root)
    squared = float(error[known] @ np.linalg.solve(base.covariance[np.ix_(known, known)], error[known]))
    unit = np.repeat([1000.0, np.degrees(1.0)], 3)
    measured = np.where(np.isfinite(variances), error * unit, np.nan)
    sizes = np.concatenate([measured, np.sqrt(variances) * unit]).tolist()
    return Frame(
        rig, seed, duration, **dict(zip([*AXES, *(f"{axis}_stddev" for axis in AXES)], sizes, strict=True)),
        nees=squared / len(known), grade=base.verdict.grade, y_is_null=y_is_null, text=base.verdict.reason,
    )  # fmt: skip


if __name__ == "__main__":
    main()
