"""Time and memory that ``calgraph calibrate`` takes for a recording, start of the interpreter included.

python benchmarks/recording_speed.py --jobs 1 2 4                    # simulates five sensors, 170 s, 200 MB
python benchmarks/recording_speed.py --case snapshots --jobs 1       # 32 snapshots of two cameras and a LiDAR
python benchmarks/recording_speed.py --rig RIG.yaml --recording DIR --jobs 1 2 4   # bits compared
"""

import os
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from calgraph.config import Board, Capture, Checkerboard
from calgraph.io.text_writing import save_yaml
from calgraph.recording import RecordingWriter, open_recording
from calgraph.sensors import CameraInfo
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    build_world,
    simulate_captures,
    simulate_rig,
    world_rig,
)
from calgraph.simulation.robot import MountedCamera
from process_costs import measure_cost
from worlds import make_parser

_SNAPSHOTS: Final = RigScenario(
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
_TIME_BETWEEN_SNAPSHOTS = 5.0
"""s, as someone who carries the board and releases all sensors at every pose takes."""


def main() -> None:
    """Prints a table of one row for each run, and whether all results are equal."""
    parser = make_parser(__doc__)
    parser.add_argument("--case", choices=["holds", "snapshots"], default="holds", help="to simulate")
    parser.add_argument("--recording", type=Path, help="simulated if left out")
    parser.add_argument("--rig", type=Path, help="of the recording; rig.yaml beside it if left out")
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--jobs", type=int, nargs="+", default=[os.cpu_count() or 1], help="numbers of processes")
    arguments = parser.parse_args()
    with TemporaryDirectory() as scratch:
        if arguments.recording is None:
            simulate = _simulate_snapshots if arguments.case == "snapshots" else _simulate_holds
            simulate(Path(scratch) / "rig")
        recording = arguments.recording or Path(scratch) / "rig" / "recording"
        rig = arguments.rig or recording.parent / "rig.yaml"
        with open_recording(recording) as opened:
            length = opened.end - opened.start
        size = sum(file.stat().st_size for file in [recording, *recording.rglob("*")] if file.is_file())
        print(f"{recording}: {length:.0f} s, {size / 1e6:.0f} MB; {os.cpu_count()} cores, load {_load()}")
        print(f"{'jobs':>4}{'wall s':>8}{'CPU s':>8}{'peak MB':>9}")
        # Installed packages are compiled; a first run, which is not measured, compiles them.
        environment = {
            **os.environ,
            "CALGRAPH_CACHE": "off",
            "PYTHONDONTWRITEBYTECODE": "",
            "PYTHONPYCACHEPREFIX": f"{scratch}/compiled",
        }
        start = [sys.executable, "-c", "from calgraph.cli import main; main()"]
        measure_cost([*start, "calibrate", str(rig), str(recording), "-o", f"{scratch}/first"], environment)
        results = []
        for run, jobs in enumerate(arguments.jobs * arguments.runs):
            command = ["calibrate", str(rig), str(recording), "--jobs", str(jobs)]
            out = Path(scratch) / f"result{run}"
            cost = measure_cost([*start, *command, "-o", str(out)], environment)
            print(f"{jobs:4}{cost.wall:8.2f}{cost.cpu:8.2f}{cost.peak / 1e6:9.0f}", flush=True)
            results.append((out / "calibration.yaml").read_text().partition("\nprovenance:")[0])
    print(f"bits of the {len(results)} results: {'identical' if len(set(results)) == 1 else 'DIFFERENT'}")


def _simulate_holds(out: Path) -> None:
    simulate_rig(RigScenario(), out, seed=0)


def _simulate_snapshots(out: Path) -> None:
    """One message for each sensor and pose, as calibration tools for cameras and LiDARs record them."""
    world = build_world(_SNAPSHOTS, seed=0)
    rig = world_rig(world).model_copy(update={"capture": Capture()})
    cameras = rig.cameras()
    models = {sensor.name: sensor.camera for sensor in world.robot if isinstance(sensor, MountedCamera)}
    with RecordingWriter(out / "recording") as writer:
        for number, capture in enumerate(simulate_captures(world, measurements=1)):
            stamp = _SNAPSHOTS.start_time + number * _TIME_BETWEEN_SNAPSHOTS
            for name, (message,) in capture.messages.items():
                writer.write(rig.sensors[name].topic, replace(message, stamp=stamp), encoding="jpeg")
                if name in models:
                    topic = cameras[name].camera_info
                    assert topic is not None
                    writer.write(topic, CameraInfo(stamp, cameras[name].frame_id or name, models[name]))
    save_yaml(out / "rig.yaml", rig.model_dump(mode="json", exclude_none=True, exclude={"settings"}))


def _load() -> str:
    return f"{os.getloadavg()[0]:.1f}"


if __name__ == "__main__":
    main()
