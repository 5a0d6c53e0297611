"""Cameras that see boards fixed in the room: errors of poses over stated ones, from simulated corners.

python benchmarks/fixed_boards.py --rigs cameras_and_lidar --paths stops ordinary carried --seeds 12
"""

import argparse
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from calgraph.boards.board_pose import fit_pose
from calgraph.boards.camera import make_board_corners
from calgraph.boards.printed_boards import compute_landmarks
from calgraph.config import Rig
from calgraph.drive.options import DriveOptions
from calgraph.drive.pipeline import calibrate_sources
from calgraph.drive.sources.camera import CameraSource, make_view
from calgraph.drive.sources.lidar import LidarReader
from calgraph.drive.sources.source import Source
from calgraph.errors import Rejected
from calgraph.geometry import se3
from calgraph.result import Calibration
from calgraph.sensors import CameraModel
from calgraph.sensors.kinds.stated import Intrinsics
from calgraph.simulation import STANDARD_RIGS, DriveScenario, SimulatedDrive, simulate_drive
from calgraph.simulation.drive_boards import SimulatedView, WallBoard

_KINDS = {"lidar": "lidar3d", "solid_state": "lidar3d", "scanner": "lidar2d", "camera": "camera"}


def make_rig(drive: SimulatedDrive, root: str) -> Rig:
    """The rig.yaml of a simulated drive, with what CameraInfo messages would state."""
    found = drive.truth.boards
    sensors: dict[str, dict[str, Any]] = {}
    for sensor in drive.scenario.sensors:
        kind = _KINDS[sensor.kind]
        topic = f"/{sensor.name}/" + {"lidar3d": "points", "lidar2d": "scan", "camera": "image"}[kind]
        sensors[sensor.name] = {"kind": kind, "topic": topic}
        if kind == "camera":
            stated = Intrinsics.from_camera(found.cameras[sensor.name].stated)
            sensors[sensor.name]["intrinsics"] = stated.model_dump(exclude_none=True)
    boards = [one.board.model_dump() for one in found.boards]
    return Rig.model_validate(
        {"root": root, "target": {"kind": "surroundings", "boards": boards}, "sensors": sensors}
    )


def make_sources(rig: Rig, drive: SimulatedDrive) -> dict[str, Source]:
    """What the sensors measured."""
    sources: dict[str, Source] = {}
    models = rig.camera_models()
    for k, (name, spec) in enumerate(rig.sensors.items()):
        if name in models:
            sources[name] = locate_boards(drive.corners[name], drive.truth.boards.boards, models[name])
            continue
        reader = LidarReader(rig, name, 3, np.random.default_rng(k))
        for message in drive.messages[spec.topic]:
            reader.add(message)
        sources[name] = reader.finish()
    return sources


def locate_boards(seen: Sequence[SimulatedView], boards: Sequence[WallBoard], camera: CameraModel) -> CameraSource:
    """The views of boards by simulated corners."""
    views = []
    for one in seen:
        corners = compute_landmarks(boards[one.board].board).corners_of(one.ids)
        pose = fit_pose(one.ids, corners, one.pixels, camera, 0.3)
        if not isinstance(pose, Rejected):
            views.append(make_view(one.stamp, make_board_corners(pose, corners, one.pixels, one.board)))
    return CameraSource(sorted(views, key=lambda view: view.time))


def compute_errors(
    drive: SimulatedDrive, calibration: Calibration
) -> dict[str, tuple[float, float, float, float]]:
    """By sensor: error, mm and degrees, squared Mahalanobis distance over 6, error of the clock, ms."""
    truth = drive.truth
    T_first_root = truth.T_root_sensor[calibration.root]
    found = {}
    for sensor in calibration.sensors:
        if sensor.name == calibration.root:
            continue
        T = se3.inverse(T_first_root) @ truth.T_root_sensor[sensor.name]
        error = se3.difference(sensor.T_root_sensor, T)
        covariance = sensor.covariance
        offset = truth.clock_offsets[sensor.name] - truth.clock_offsets[calibration.root]
        found[sensor.name] = (
            1e3 * float(np.linalg.norm(error[:3])),
            float(np.degrees(np.linalg.norm(error[3:]))),
            float(error @ np.linalg.solve(covariance, error)) / 6,
            1e3 * ((sensor.clock_offset or 0.0) - offset),
        )
    return found


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", nargs="+", choices=STANDARD_RIGS, default=["cameras_and_lidar"])
    parser.add_argument("--paths", nargs="+", default=["stops", "ordinary", "carried"])
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--duration", type=float, default=60.0)
    parser.add_argument("--root", default="")
    parser.add_argument("--boards", type=int, default=6)
    options = parser.parse_args()
    for rig_name in options.rigs:
        for path in options.paths:
            rows = []
            for seed in range(options.first, options.first + options.seeds):
                scenario = DriveScenario(
                    seed=seed, duration=options.duration, sensors=STANDARD_RIGS[rig_name], path=path, world="room",
                    boards=options.boards,
                )  # fmt: skip
                started = time.process_time()
                drive = simulate_drive(scenario)
                simulated = time.process_time()
                rig = make_rig(drive, options.root or drive.root)
                calibration = calibrate_sources(rig, make_sources(rig, drive), {}, (), DriveOptions())
                errors = compute_errors(drive, calibration)
                print(
                    f"{rig_name} {path} {seed}: simulated {simulated - started:.0f} s, "
                    f"calibrated {time.process_time() - simulated:.0f} s"
                )
                for name, (mm, degrees, nees, clock) in errors.items():
                    stated = calibration[name].covariance
                    sigma = 1e3 * np.sqrt(np.diag(stated)[:3].max())
                    print(
                        f"  {name:14} {mm:6.1f} mm (stated {sigma:.1f}) {degrees:6.3f}° NEES {nees:6.2f} "
                        f"clock {clock:5.1f} ms"
                    )
                for name, reason in calibration.evidence.unconnected.items():
                    print(f"  {name}: {reason}")
                rows += list(errors.values())
            if rows:
                mm, degrees, nees, clock = np.array(rows).T
                print(
                    f"{rig_name} {path}: median {np.median(mm):.1f} mm {np.median(degrees):.3f}°, at most "
                    f"{mm.max():.1f} mm {degrees.max():.3f}°, NEES {nees.mean():.2f} (median {np.median(nees):.2f}"
                    "), "
                    f"clock {np.median(np.abs(clock)):.1f} ms, {len(rows)} poses",
                    flush=True,
                )


if __name__ == "__main__":
    main()
