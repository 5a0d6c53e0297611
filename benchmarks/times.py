"""Processor time, wall time and memory that calibrations take, start of the interpreter included.

python benchmarks/times.py                                         # all cases, in one process
python benchmarks/times.py rig snapshots --processes 1 2 4 --runs 3
python benchmarks/times.py --keep DIR --csv build/before.csv       # recordings are kept, and used again
python benchmarks/times.py mine --keep DIR                         # of DIR/mine/recording with DIR/mine/rig.yaml
OMP_NUM_THREADS=1 python benchmarks/times.py bundle_120 sweep      # parts, in this process

Cases are whole runs of ``calgraph calibrate`` without the cache, of simulated recordings with seed 0, or the
processor time of parts: of the joint solution from pairs to covariances (``bundle_N``: N captures, five sensors),
and of the detection in one sweep (``sweep``). Figures are medians of the runs; the last column states whether all
runs of a case have the same bits.
"""

import hashlib
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from calgraph.config import Board, Capture, Charuco, Checkerboard, Lidar3dSpec, RangeNoise, Rig, SensorSpec
from calgraph.geometry import se3, so3
from calgraph.io.text_writing import save_yaml
from calgraph.io.yaml_reading import read_yaml
from calgraph.recording import RecordingWriter
from calgraph.rig.bundle.estimate import solve_bundle
from calgraph.rig.captures.detectors import make_detectors
from calgraph.rig.detection.capture_background import learn_capture_background
from calgraph.rig.options import RigOptions
from calgraph.rig.pairs.board_pair import select_successful
from calgraph.rig.pipeline import build_problem_from_captures
from calgraph.sensors import CameraInfo, PointCloud
from calgraph.sensors.beam_pattern import multibeam_pattern
from calgraph.simulation import (
    BeamOptions,
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    NetworkScenario,
    RigScenario,
    SpinningOptions,
    build_world,
    simulate_network,
    simulate_rig,
    world_rig,
)
from calgraph.simulation.motion import BoardPlacement
from calgraph.simulation.robot import MountedCamera
from calgraph.simulation.scanners import point_cloud, simulate_ranges
from calgraph.simulation.solids import Solid
from calgraph.simulation.world import board_solid, build_room, operator_solids
from ideal_detections import simulate_detections
from process_costs import measure_cost
from simulated_captures import simulate_captures
from worlds import NAN, Layout, grouped, make_parser, median, run_worlds

SNAPSHOTS = RigScenario(
    camera=CameraOptions(count=2, width=1280, height=960, field_of_view=110),
    laser=LaserOptions(count=0),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=1, rings=16),
    board=Board(
        size=(1.0, 0.8),
        pattern=Checkerboard(kind="checkerboard", columns=8, rows=6, square=0.1, center=(0.0, 0.0)),
    ),
    bearings=(-8, -5, -3, -1, 1, 3, 5, 8),
    radii=(1.7, 2.5),
    samples=2,
)
"""Every pose of the checkerboard is in the view of both cameras; the LiDAR has 16 beams of 1800 points."""
SQUARE_BOARD = Board(
    size=(0.9, 0.9),
    pattern=Checkerboard(kind="checkerboard", columns=10, rows=10, square=0.075, center=(0.0, 0.0)),
)
CAMERAS = RigScenario(
    camera=CameraOptions(count=3),
    laser=LaserOptions(count=0),
    spinning=SpinningOptions(count=0),
    board=Board(
        size=(1.0, 0.7),
        pattern=Charuco(
            kind="charuco", columns=10, rows=7, square=0.1, marker=0.075, dictionary="DICT_5X5_100", first_id=0
        ),
    ),
    bearings=(-20, -10, 0, 10, 20),
    radii=(1.5, 2.2),
    samples=3,
)
SWEEP = np.radians(np.linspace(-18, 14, 64)), float(np.radians(0.35)), 0.1
"""A LiDAR with 64 rings: elevations and step of the azimuth, rad, and period, s."""
SWEEP_NOISE = BeamOptions(dropout=0.01, max_range=40.0)
_TIME_BETWEEN_SNAPSHOTS = 5.0
"""s, as someone who carries the board and releases all sensors at every pose takes."""


def _write_holds(scenario: RigScenario, out: Path) -> None:
    simulate_rig(scenario, out, seed=0)


def _write_snapshots(scenario: RigScenario, out: Path) -> None:
    """One message for each sensor and pose, as calibration tools for cameras and LiDARs record them."""
    world = build_world(scenario, seed=0)
    rig = world_rig(world).model_copy(update={"capture": Capture()})
    cameras = rig.cameras()
    models = {sensor.name: sensor.camera for sensor in world.robot if isinstance(sensor, MountedCamera)}
    with RecordingWriter(out / "recording") as writer:
        for number, capture in enumerate(simulate_captures(world, measurements=1)):
            stamp = scenario.start_time + number * _TIME_BETWEEN_SNAPSHOTS
            for name, (message,) in capture.messages.items():
                writer.write(rig.sensors[name].topic, replace(message, stamp=stamp), encoding="jpeg")
                if name in models:
                    topic = cameras[name].camera_info
                    assert topic is not None
                    writer.write(topic, CameraInfo(stamp, cameras[name].frame_id or name, models[name]))
    save_yaml(out / "rig.yaml", rig.model_dump(mode="json", exclude_none=True, exclude={"settings"}))


def _write_without_intrinsics(scenario: RigScenario, out: Path) -> None:
    simulate_rig(scenario, out, seed=0)
    rig = read_yaml(out / "rig.yaml")
    for spec in rig["sensors"].values():
        # Else those beside the images are taken.
        spec.pop("camera_info")
        spec["intrinsics"] = "estimate"
    save_yaml(out / "rig.yaml", rig)


def _write_network(scenario: NetworkScenario, out: Path) -> None:
    simulate_network(scenario, out, seed=0)


RECORDINGS: Mapping[str, Callable[[Path], None]] = {
    "rig": partial(_write_holds, RigScenario()),
    "snapshots": partial(_write_snapshots, SNAPSHOTS),
    "snapshots_10x10": partial(_write_snapshots, SNAPSHOTS.model_copy(update={"board": SQUARE_BOARD})),
    "cameras": partial(_write_without_intrinsics, CAMERAS),
    "cameras_given": partial(_write_holds, CAMERAS),
    "scanners": partial(_write_network, NetworkScenario(duration=60.0)),
}
"""Recordings that are simulated into a folder, with rig.yaml: five sensors and 48 holds; 32 snapshots; 3 cameras
without intrinsics, and with them; six scanners in an office for a minute."""


def _time_bundle(captures: int) -> float:
    world = build_world(RigScenario(samples=captures // 24), 0, images=False)
    rig, captured, _ = simulate_detections(world, 0)
    # Nothing is to be selected among clean detections, and the hypergraph's time is not this one's.
    problem = build_problem_from_captures(rig, captured, RigOptions(keep="none"), np.random.default_rng(0))
    began = time.process_time()
    start = problem.tree.T_root_sensor
    solve_bundle(problem.rig, problem.captures, select_successful(problem.pairs), start, keep="none")
    return time.process_time() - began


def _time_sweep() -> float:
    """An unorganised sweep of a LiDAR with 64 rings in clutter, in front of the background of 12 captures."""
    rng, pattern = np.random.default_rng((0, 1, 3)), multibeam_pattern(*SWEEP)
    T_world_sensor = se3.pose(so3.exp(rng.normal(0, 0.02, 3)), np.array([0.0, 0.0, rng.uniform(0.9, 1.3)]))
    room = build_room(rng, 24, 2.2)
    rng.uniform(size=6)  # of scenes in which the board stays in its place
    clouds: list[PointCloud] = []
    for stamp in range(12):
        turn = so3.exp(rng.uniform(-0.5, 0.5, 3))
        placement = BoardPlacement(rng.uniform(-0.7, 0.7), rng.uniform(1.6, 3.0), rng.uniform(0.75, 1.15), turn)
        board = SNAPSHOTS.board.size
        solids = (*room, board_solid(placement, board), *operator_solids(placement, board))
        ranges = simulate_ranges(pattern, T_world_sensor, 0.0, partial(_rest, solids), SWEEP_NOISE, rng)
        cloud = point_cloud(pattern, ranges, float(stamp), "lidar")
        order = rng.permutation(len(cloud.points))
        clouds.append(replace(cloud, points=cloud.points[order], rings=None, times=None))
    stated = RangeNoise(range=SWEEP_NOISE.range_noise, angle=SWEEP_NOISE.angle_noise)
    sensors: dict[str, SensorSpec] = {
        "lidar": Lidar3dSpec(topic="/points", noise=stated),
        "other": Lidar3dSpec(topic="/other"),
    }
    rig = Rig(root="lidar", target=SNAPSHOTS.board, sensors=sensors)
    began = time.process_time()
    learned = learn_capture_background(clouds, stated, rig.settings.detection)
    detect = make_detectors(rig, {}, {"lidar": learned}, None, {"lidar": 0, "other": 0})["lidar"]
    for cloud in clouds:
        detect([cloud])
    return (time.process_time() - began) / len(clouds)


def _rest(solids: Sequence[Solid], _start: float, _end: float) -> list[tuple[float, Sequence[Solid]]]:
    """A scene in which nothing moves during a sweep."""
    return [(np.inf, solids)]


PARTS: Mapping[str, Callable[[], float]] = {
    **{f"bundle_{captures}": partial(_time_bundle, captures) for captures in (48, 120, 504, 1008)},
    "sweep": _time_sweep,
}
"""Parts of calibrations: their processor time, s."""


@dataclass(frozen=True)
class Row:
    """One run."""

    case: str
    processes: int
    run: int
    cpu: float
    """s, of all processes."""
    wall: float
    """s."""
    megabytes: float
    """Most of all processes together."""
    digest: str
    """Of calibration.yaml, without provenance."""


def main() -> None:
    """Prints a line for each case and number of processes."""
    parser = make_parser(__doc__, jobs=1)
    names = [*RECORDINGS, *PARTS]
    parser.add_argument("cases", nargs="*", default=names, help=f"of {', '.join(names)}, and folders in --keep")
    parser.add_argument("--processes", type=int, nargs="+", default=[1], help="of each calibration")
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder of the recordings, by case")
    arguments = parser.parse_args()
    with TemporaryDirectory() as scratch:
        folder = arguments.keep or Path(scratch)
        work = [
            (case, processes, run, folder)
            for case in arguments.cases
            for processes in (arguments.processes if case not in PARTS else [1])
            for run in range(arguments.runs)
        ]
        rows = run_worlds(Row, measure, work, arguments, key=3)
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    table = Layout("case:18 processes:9d runs:4d CPU_s:8.2f wall_s:8.2f MB:7.0f bits:10")
    print(table.head)
    for (case, processes), runs in grouped(rows, lambda row: (row.case, row.processes)):
        medians = (median([getattr(row, name) for row in runs]) for name in ("cpu", "wall", "megabytes"))
        equal = len({row.digest for row in rows if row.case == case}) == 1
        print(table.line(case, processes, len(runs), *medians, "identical" if equal else "DIFFERENT"))


def measure(case: str, processes: int, run: int, folder: Path) -> Row:
    """One run of a case."""
    if case in PARTS:
        return Row(case, processes, run, PARTS[case](), NAN, NAN, "")
    place = folder / case
    # Installed packages are compiled, too.
    compiled = {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": str(folder / "compiled")}
    environment = {**os.environ, **compiled, "CALGRAPH_CACHE": "off"}
    if not (place / "rig.yaml").exists():
        RECORDINGS[case](place)
    command = [sys.executable, "-c", "from calgraph.cli import main; main()", "calibrate"]
    command += [str(place / "rig.yaml"), str(place / "recording"), "--force", "--jobs", str(processes)]
    with TemporaryDirectory() as scratch:
        # A first run, which is not measured, compiles them.
        for _ in range(1 if (folder / "compiled").exists() else 2):
            cost = measure_cost([*command, "-o", f"{scratch}/result"], environment)
        content = (Path(scratch) / "result" / "calibration.yaml").read_text().partition("\nprovenance:")[0]
    digest = hashlib.sha256(content.encode()).hexdigest()[:16]
    return Row(case, processes, run, cost.cpu, cost.wall, cost.peak / 1e6, digest)


if __name__ == "__main__":
    main()
