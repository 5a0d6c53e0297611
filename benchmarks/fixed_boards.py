"""Cameras that see boards fixed in the room, from simulated corners: errors, NEES and verdicts, as in drives.py.

python benchmarks/fixed_boards.py --rigs cameras_and_lidar --kinds stops ordinary carried --seeds 700 704

Kinds are those of paths. A row is one sensor besides the root; judged_sensors.py states what its columns are.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
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
from calgraph.sensors import CameraModel
from calgraph.sensors.kinds.stated import Intrinsics
from calgraph.simulation import STANDARD_RIGS, DriveScenario, SimulatedDrive, simulate_drive
from calgraph.simulation.drive_boards import WallBoard
from calgraph.simulation.drive_scenario import DRIVE_KINDS
from drive_detections import SimulatedView, detect_views
from judged_sensors import Outcome, Truth, judge, list_worlds, make_judging_parser, measure, show_outcomes
from worlds import run_worlds

RIGS = ("cameras_and_lidar", "three_cameras")
PATHS = ("stops", "ordinary", "carried")


def make_rig(drive: SimulatedDrive) -> Rig:
    """The rig.yaml of a simulated drive, with what CameraInfo messages would state."""
    found = drive.truth.boards
    sensors: dict[str, dict[str, Any]] = {}
    for sensor in drive.scenario.sensors:
        kind = DRIVE_KINDS[sensor.kind]
        sensors[sensor.name] = {"kind": kind, "topic": drive.topics[sensor.name]}
        if kind == "camera":
            stated = Intrinsics.from_camera(found.cameras[sensor.name].stated)
            sensors[sensor.name]["intrinsics"] = stated.model_dump(exclude_none=True)
    boards = [one.board.model_dump() for one in found.boards]
    return Rig.model_validate(
        {"root": drive.root, "target": {"kind": "surroundings", "boards": boards}, "sensors": sensors}
    )


def make_sources(rig: Rig, drive: SimulatedDrive) -> dict[str, Source]:
    """What the sensors measured."""
    sources: dict[str, Source] = {}
    models, seen = rig.camera_models(), detect_views(drive)
    for k, (name, spec) in enumerate(rig.sensors.items()):
        if name in models:
            sources[name] = locate_boards(seen[name], drive.truth.boards.boards, models[name])
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


def run(path: str, rig_name: str, seed: int, duration: float) -> list[Outcome]:
    """Simulates and calibrates one drive past six boards."""
    began = time.process_time()
    drive = simulate_drive(
        DriveScenario(seed, duration, STANDARD_RIGS[rig_name], path, "room")  # type: ignore[arg-type, index]
    )
    rig = make_rig(drive)
    first = Outcome(path, rig_name, seed, duration, "", simulated_seconds=time.process_time() - began)
    row, found = measure(first, lambda: calibrate_sources(rig, make_sources(rig, drive), {}, (), DriveOptions()))
    if found is None:
        return [row]
    truth = Truth(drive.truth.T_root_sensor, drive.truth.clock_offsets)
    return [judge(replace(row, sensor=name), found, truth) for name in rig.sensors if name != found.root]


def main() -> None:
    """Prints a table by path and rig, what is confidently wrong, and all reasons."""
    arguments = make_judging_parser(__doc__, PATHS, PATHS, RIGS, (0.01, 0.3)).parse_args()
    outcomes = run_worlds(Outcome, run, list_worlds(arguments, PATHS), arguments, key=4)
    show_outcomes(outcomes, arguments.verbose)


if __name__ == "__main__":
    main()
