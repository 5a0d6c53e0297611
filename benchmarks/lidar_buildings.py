"""Time, memory and errors of networks of many 3-D LiDARs: a floor of bays with one LiDAR of 16 rings in each.

Eight walkers for ten LiDARs 7 m apart, sweeps at 5 Hz, as rosbag2. Seconds are of processors, of all processes
together, by stage; memory is the most of the calibrating process, and of any other. After the table is the
exponent of the processor time over the number of LiDARs. Poses and covariances with the same bits have the same
mark.

    python benchmarks/lidar_buildings.py --sizes 10 20 40 100 --duration 20
    python benchmarks/lidar_buildings.py --sizes 10 --jobs 2 --keep buildings
    python benchmarks/lidar_buildings.py --sizes 10 --cluster --keep buildings

``--keep`` writes recordings into a folder; those that are there are not simulated again.
"""

import tempfile
from contextlib import ExitStack
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calgraph.config import load_rig
from calgraph.geometry import measure_lengths, se3
from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import calibrate_network
from calgraph.parallel.engine import Processes
from calgraph.parallel.open_cluster import open_cluster
from calgraph.recording import open_recordings
from calgraph.simulation.hall_scenario import HallScenario, LidarModel
from calgraph.simulation.hall_simulation import record_hall
from calgraph.simulation.truth import load_truth
from hall_buildings import simulate_building
from network_stages import Stopwatch, fit_slope
from process_costs import in_process, measure_peak_memories
from worlds import make_parser

STAGES = ("tracking", "pairing", "averaging", "solving", "assembling")
SEED = 1


class Row(NamedTuple):
    """What one calibration took, and its errors."""

    connected: int
    seconds: dict[str, float]
    """Processor time by stage, s."""
    wall: float
    """s."""
    memories: tuple[float, float]
    """MB."""
    errors: np.ndarray
    """(S, 2) of the connected LiDARs but the root, mm and degrees."""
    nees: float
    """Mean over these."""
    mark: str
    """Of poses and covariances."""


def main() -> None:
    """Prints the table."""
    parser = make_parser(__doc__)
    parser.add_argument("--sizes", nargs="+", type=int, default=[10, 20, 40], help="numbers of LiDARs")
    parser.add_argument("--duration", type=float, default=20.0, help="s")
    parser.add_argument("--jobs", type=int, default=1, help="processes of each calibration")
    parser.add_argument("--cluster", action="store_true", help="calibrate on Dask's workers of this machine")
    parser.add_argument("--keep", type=Path, help="folder for recordings")
    options = parser.parse_args()
    with ExitStack() as stack:
        keep = options.keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        print(
            f"{'LiDARs':>6}{'poses':>7}" + "".join(f"{stage:>11}" for stage in (*STAGES, "all"))
            + f"{'clock':>8}{'MB':>7}{'MB':>7}{'mm':>7}{'most':>7}{'deg':>7}{'NEES':>6}  mark"
        )  # fmt: skip
        totals = []
        for count in options.sizes:
            place = keep / f"{count}x{options.duration:g}"
            if not (place / "truth.yaml").exists():
                in_process(simulate, place, count, options.duration)
            row = in_process(calibrate, place, options.jobs, options.cluster)
            totals.append(sum(row.seconds.values()))
            print(f"{count:6d}{format_row(row)}", flush=True)
        if len(totals) > 1:
            print(f"exponent {fit_slope(np.log(options.sizes), totals):.2f}")


def simulate(place: Path, count: int, duration: float) -> None:
    """Writes the recording of a building."""
    model: LidarModel = "slow16"
    scenario = HallScenario(SEED, duration, (model,) * count)
    record_hall(simulate_building(scenario), place, lambda _done, _total: None)


def calibrate(place: Path, jobs: int, cluster: bool) -> Row:
    """Calibrates a recording."""
    rig = load_rig(place / "rig.yaml")
    clock = Stopwatch()
    with ExitStack() as stack:
        engine = (
            stack.enter_context(open_cluster("local", jobs, rig.settings.cluster)) if cluster else Processes(jobs)
        )
        recording = stack.enter_context(open_recordings([place / "recording"]))
        found = calibrate_network(rig, recording, NetworkOptions(engine=engine), clock.progress)
    clock.lap("assembling")
    truth = load_truth(place / "truth.yaml").T_root_sensor
    errors = np.reshape([se3.difference(one.T_root_sensor, truth[one.name]) for one in found.sensors[1:]], (-1, 6))
    squares = [
        error @ np.linalg.solve(one.covariance, error) / 6
        for error, one in zip(errors, found.sensors[1:], strict=True)
    ]
    poses = np.array([one.T_root_sensor for one in found.sensors])
    return Row(
        len(found.sensors),
        clock.seconds,
        clock.wall(),
        measure_peak_memories(),
        np.column_stack([1000 * measure_lengths(errors[:, :3]), np.degrees(measure_lengths(errors[:, 3:]))]),
        float(np.mean(squares)),
        sha256(poses.tobytes() + found.joint_covariance.tobytes()).hexdigest()[:8],
    )


def format_row(row: Row) -> str:
    """The row of one size."""
    by_stage = [row.seconds[one] for one in STAGES]
    seconds = "".join(f"{value:11.1f}" for value in (*by_stage, sum(row.seconds.values())))
    memories = "".join(f"{value:7.0f}" for value in row.memories)
    middle, most = np.median(row.errors, axis=0), row.errors[:, 0].max()
    errors = f"{middle[0]:7.1f}{most:7.1f}{middle[1]:7.3f}{row.nees:6.2f}"
    return f"{row.connected:7d}{seconds}{row.wall:8.1f}{memories}{errors}  {row.mark}"


if __name__ == "__main__":
    main()
