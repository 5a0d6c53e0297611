"""Detection of the board in sweeps without a background window: CPU time, detections, errors.

python benchmarks/sweep_detection.py                       # every scene with every sensor, 35 recordings
python benchmarks/sweep_detection.py --scenes open wall --sensors 16 --seeds 0 1 2

Every recording is searched twice: in whole clouds, and in front of the background learned from its captures.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from calgraph.boards.detections import PlanePatch
from calgraph.config import Board, CameraSpec, Capture, Checkerboard, Lidar3dSpec, RangeNoise, Rig
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3, so3
from calgraph.rig.captures.detectors import make_detectors
from calgraph.rig.detection.capture_background import learn_capture_background
from calgraph.sensors import PointCloud
from calgraph.simulation import BeamOptions
from calgraph.simulation.motion import BoardPlacement, pose_from_placement
from calgraph.simulation.scanners import (
    BeamPattern,
    laser_pattern,
    multibeam_pattern,
    point_cloud,
    simulate_ranges,
    spinning_pattern,
)
from calgraph.simulation.solids import BoxShape, Solid
from calgraph.simulation.world import board_solid, build_room, operator_solids
from worlds import make_parser

_BOARD: Final = Board(
    size=(1.0, 0.8), pattern=Checkerboard(kind="checkerboard", columns=8, rows=6, square=0.1, center=(0.0, 0.0))
)
_NOISE: Final = BeamOptions(
    range_noise=0.012, angle_noise=0.001, mixed_pixels=0.3, dropout=0.01, min_range=0.1, max_range=40.0
)
_SCENES: Final = ("open", "clutter", "wall", "tripod", "one place", "bystander", "moving rig")
_SENSORS: Final = ("16", "32", "64", "unorganised", "spinning")
_CAPTURES = 12
_TOLERATED = (0.06, 0.1, 0.3)
"""Errors of a patch that is the board: of the plane at the board's centre, m, of its normal, rad, and of the
patch's centre, m."""
_STATED: Final = RangeNoise(range=_NOISE.range_noise, angle=_NOISE.angle_noise)


@dataclass(frozen=True, eq=False)
class Sweep:
    """One capture of a simulated recording."""

    cloud: PointCloud
    T_sensor_board: Array


def main() -> None:
    """Prints a row for each scene and sensor, and one for all."""
    parser = make_parser(__doc__)
    parser.add_argument("--scenes", nargs="+", choices=_SCENES, default=_SCENES)
    parser.add_argument("--sensors", nargs="+", choices=_SENSORS, default=_SENSORS)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    arguments = parser.parse_args()
    print("whole clouds -> in front of the background learned from the captures. ms: CPU time for each sweep;")
    print(
        "others: candidates besides the board for each sweep; mm, degrees: RMS errors of the plane at the board's"
    )
    print("centre and of its normal, of sweeps in which both find it")
    print(f"{'scene':12}{'sensor':12}{'n':>4}{'ms':>11}{'found':>13}{'first':>13}{'others':>13}", end="")
    print(f"{'mm':>13}{'degrees':>16}")
    rows = []
    for scene in arguments.scenes:
        for sensor in arguments.sensors:
            measured = [row for seed in arguments.seeds for row in measure_sweeps(scene, sensor, seed)]
            _print_row(scene, sensor, np.array(measured))
            rows += measured
    _print_row("all", "", np.array(rows))


def _print_row(scene: str, sensor: str, rows: Array) -> None:
    """Prints the means of rows (N, 2, 6)."""
    ms, found, first, others = rows[:, :, :4].mean(axis=0).T
    both = np.isfinite(rows[:, :, 4]).all(axis=1)
    offset, angle = np.sqrt((rows[both, :, 4:] ** 2).mean(axis=0)).T * [[1000.0], [180 / np.pi]]
    print(f"{scene:12}{sensor:12}{len(rows):4}{ms[0]:5.0f} ->{ms[1]:3.0f}", end="")
    print(f"{found[0]:6.0%} ->{found[1]:4.0%}{first[0]:6.0%} ->{first[1]:4.0%}", end="")
    print(f"{others[0]:6.2f} ->{others[1]:4.2f}{offset[0]:6.2f} ->{offset[1]:4.2f}", end="")
    print(f"{angle[0]:8.3f} ->{angle[1]:5.3f}", flush=True)


def measure_sweeps(scene: str, sensor: str, seed: int) -> list[list[list[float]]]:
    """Of each sweep, without and with a background: ms, found, found first, other candidates, and errors."""
    sweeps = _simulate(scene, sensor, seed)
    spec = Lidar3dSpec(kind="lidar3d", topic="/points", noise=_STATED)
    camera = CameraSpec(kind="camera", topic="/image", camera_info="/camera_info")
    rig = Rig(root="lidar", target=_BOARD, capture=Capture(), sensors={"lidar": spec, "camera": camera})
    return [list(pair) for pair in zip(_search(rig, sweeps, False), _search(rig, sweeps, True), strict=True)]


def _search(rig: Rig, sweeps: list[Sweep], learn: bool) -> list[list[float]]:
    began = time.process_time()
    clouds = [sweep.cloud for sweep in sweeps]
    learned = {"lidar": learn_capture_background(clouds, _STATED, rig.settings.detection)} if learn else {}
    lidar = rig.model_copy(update={"sensors": {"lidar": rig.sensors["lidar"]}})
    detect = make_detectors(lidar, {}, learned, None, {"lidar": 0})["lidar"]
    results = [detect([sweep.cloud]) for sweep in sweeps]
    ms = 1000 * (time.process_time() - began) / len(sweeps)
    rows = []
    for sweep, result in zip(sweeps, results, strict=True):
        patches = [] if isinstance(result, Rejected) else [p for p in result if isinstance(p, PlanePatch)]
        errors = [_compute_errors(patch, sweep.T_sensor_board) for patch in patches]
        right = [i for i, error in enumerate(errors) if np.all(np.array(error) < _TOLERATED)]
        best = errors[right[0]][:2] if right else (np.nan, np.nan)
        rows.append([ms, bool(right), 0 in right, len(patches) - len(right), *best])
    return rows


def _compute_errors(patch: PlanePatch, T_sensor_board: Array) -> tuple[float, float, float]:
    """Distance of the board's centre from the plane, m, angle of the normal, rad, distance of the centres, m."""
    normal, center = T_sensor_board[:3, 2], T_sensor_board[:3, 3]
    offset = abs(float(patch.plane[:3] @ center + patch.plane[3]))
    angle = float(np.linalg.norm(np.cross(patch.plane[:3], normal)))
    return offset, angle, float(np.linalg.norm(patch.center - center))


def _simulate(scene: str, sensor: str, seed: int) -> list[Sweep]:
    """The sweeps of one recording, one a capture."""
    rng = np.random.default_rng((seed, _SCENES.index(scene), _SENSORS.index(sensor)))
    pattern = _build_pattern(sensor)
    T_world_sensor = se3.pose(so3.exp(rng.normal(0, 0.02, 3)), np.array([0.0, 0.0, rng.uniform(0.9, 1.3)]))
    room = build_room(rng, 24 if scene == "clutter" else 8, 2.2 if scene == "clutter" else 3.2)
    if scene == "wall":
        room = (*room, Solid(BoxShape(0.1, 4.0, 2.4), se3.pose(np.eye(3), np.array([3.0, 0.0, 1.2]))))
    if scene == "bystander":
        person = BoardPlacement(rng.uniform(-1, 1), rng.uniform(2.0, 3.0), 1.0, np.eye(3))
        room = (*room, *operator_solids(person, (0.5, 0.4)))
    sweeps: list[Sweep] = []
    for placement in _place_board(scene, rng):
        solids = (*room, board_solid(placement, _BOARD.size), *operator_solids(placement, _BOARD.size))
        if scene == "moving rig":
            turn = so3.exp(np.array([0.0, 0.0, rng.uniform(-0.3, 0.3)]))
            T_world_sensor = se3.pose(turn, np.array([*rng.uniform(-0.5, 0.5, 2), 1.1]))
        ranges = simulate_ranges(pattern, T_world_sensor, 0.0, partial(_rest, solids), _NOISE, rng)
        cloud = point_cloud(pattern, ranges, float(len(sweeps)), "lidar")
        if sensor == "unorganised":
            order = rng.permutation(len(cloud.points))
            cloud = replace(cloud, points=cloud.points[order], rings=None, times=None)
        sweeps.append(Sweep(cloud, se3.inverse(T_world_sensor) @ pose_from_placement(placement)))
    return sweeps


def _rest(solids: tuple[Solid, ...], _start: float, _end: float) -> list[tuple[float, tuple[Solid, ...]]]:
    """A scene in which nothing moves during a sweep."""
    return [(np.inf, solids)]


def _place_board(scene: str, rng: np.random.Generator) -> Iterator[BoardPlacement]:
    """The board and its operator in every capture."""
    usual = rng.uniform(-0.5, 0.5), rng.uniform(1.8, 3.0), rng.uniform(0.8, 1.1)
    resting = so3.exp(rng.uniform(-0.4, 0.4, 3))
    for number in range(_CAPTURES):
        turn = so3.exp(rng.uniform(-0.5, 0.5, 3))
        drawn = rng.uniform(-0.7, 0.7), rng.uniform(1.6, 3.0), rng.uniform(0.75, 1.15)
        stands = scene == "tripod" or (scene == "one place" and number < 0.8 * _CAPTURES)
        bearing, radius, height = usual if stands else drawn
        if scene == "wall":
            # The centre 0.1 to 0.4 m in front of the wall, turned no further than the wall allows.
            gap = rng.uniform(0.1, 0.4)
            radius = (2.95 - gap) / np.cos(bearing)
            turn = so3.exp(np.array([0.0, -bearing, 0.0])) @ so3.exp(rng.uniform(-1, 1, 3) * [1, 1, 0] * 0.5 * gap)
            yield BoardPlacement(
                bearing, radius, height, turn, standoff=-0.1, side=float(rng.choice([-0.85, 0.85]))
            )
        else:
            rotation = resting if scene == "one place" and stands else turn
            yield BoardPlacement(bearing, radius, height, rotation)


def _build_pattern(sensor: str) -> BeamPattern:
    if sensor == "spinning":
        laser = laser_pattern(np.radians(270), np.radians(0.5), 0.02)
        return spinning_pattern(laser, 0.02, np.radians(8), 0.05, 1 / 3, np.pi)
    elevations = {"16": (-15, 15, 16), "32": (-25, 15, 32), "64": (-18, 14, 64), "unorganised": (-18, 14, 64)}
    low, high, rings = elevations[sensor]
    return multibeam_pattern(
        np.radians(np.linspace(low, high, rings)), np.radians(0.2 if rings < 64 else 0.35), 0.1
    )


if __name__ == "__main__":
    main()
