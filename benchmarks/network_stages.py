"""Time, memory and errors of whole calibrations of networks, stage by stage, against their scanners and minutes.

Each size, such as 30x1, is a number of scanners and minutes, of a building (corridors, halls and offices) or of a
grid, with two walkers for five scanners, recorded as a rosbag2 folder. Seconds are of processors, of all processes
together; memory is the most that any process held, the calibrating one or one that it started. After the table is
the exponent of the processor time over the number of scanners, for each number of minutes.

Scanners overlap that observe the same people for 2 s or longer. Errors are those of the relative translation of
these pairs.
A scanner is grossly wrong if it is off by more than 0.1 m or 2 degrees relative to most of its neighbours.

    python benchmarks/network_stages.py --sizes 30x1 100x1 300x1 1000x1 100x10 --layout building --jobs 4
    python benchmarks/network_stages.py --sizes 100x10 --layout grid --keep DIR

``--keep`` writes recordings and results into a folder; recordings that are there are not simulated again.
"""

import tempfile
import time
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np

from calgraph.config import load_rig
from calgraph.io.text_writing import save_yaml
from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import calibrate_network
from calgraph.parallel.engine import Processes
from calgraph.recording import open_recordings
from calgraph.report import write_report
from calgraph.result import save_calibration, save_captures, save_scene
from calgraph.simulation import LayoutName, NetworkScenario, simulate_network
from network_measures import SEED, Quality, find_overlaps, judge_poses
from process_costs import in_process, measure_cpu, measure_peak_memories
from worlds import make_parser

STAGES = ("tracking", "pairing", "averaging", "solving", "assembling", "writing")
SIZES = ("30x1", "100x1", "300x1", "100x10")
WALKERS = 0.4
"""For each scanner."""


class Row(NamedTuple):
    """What one calibration took, and its quality."""

    tried: int
    """Pairs of scanners for which a relative pose was looked for."""
    right: int
    """Those that have one that agrees with the result."""
    seconds: dict[str, float]
    """Processor time of all processes by stage, s."""
    wall: float
    """s."""
    memories: tuple[float, float]
    """Most of the calibrating process, and of any that it started, MB."""
    quality: Quality


def main() -> None:
    """Prints the tables."""
    parser = make_parser(__doc__)
    parser.add_argument("--sizes", nargs="+", default=list(SIZES), help="scanners x minutes")
    parser.add_argument("--layout", default="building", choices=get_args(LayoutName))
    parser.add_argument("--jobs", type=int, default=1, help="processes of the simulation and of each calibration")
    parser.add_argument("--keep", type=Path, help="folder of recordings and results")
    options = parser.parse_args()
    with ExitStack() as stack:
        keep = options.keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        rows = {}
        print(HEADER)
        for size in options.sizes:
            place = keep / f"{options.layout}_{size}"
            # Separate processes, so that time and memory are those of this calibration.
            if not (place / "truth.yaml").exists():
                in_process(simulate, place, options.layout, size, options.jobs)
            rows[size] = in_process(calibrate, place, options.jobs)
            print(f"{size:9}{format_row(rows[size])}", flush=True)
    print_exponents(rows)


def simulate(place: Path, layout: LayoutName, size: str, jobs: int) -> None:
    """Writes the recording of a network, its rig.yaml, ground truth and scenario."""
    count, minutes = (int(part) for part in size.split("x"))
    scenario = NetworkScenario(
        layout=layout,
        clutter=2 * count,
        duration=60.0 * minutes,
        scanner={"count": count},  # type: ignore[arg-type]
        people={"count": max(2, round(WALKERS * count))},  # type: ignore[arg-type]
    )
    place.mkdir(parents=True, exist_ok=True)
    save_yaml(place / "scenario.yaml", scenario.model_dump(mode="json", exclude_none=True), f"seed: {SEED}")
    simulate_network(scenario, place, SEED, jobs=jobs)


def calibrate(place: Path, jobs: int) -> Row:
    """Calibrates the recording in a folder, and writes all files beside it."""
    overlaps = in_process(find_overlaps, place)
    rig = load_rig(place / "rig.yaml").model_copy(update={"root": overlaps.root})
    clock = Stopwatch()
    with open_recordings([place / "recording"]) as recording:
        options = NetworkOptions(engine=Processes(jobs))
        found = calibrate_network(rig, recording, options, clock.progress)
    clock.lap("assembling")
    save_calibration(found, place / "calibration.yaml")
    save_captures(found, place / "captures.csv")
    write_report(found, rig, place / "report.html")
    save_scene(found.pictures, place / "scene.npz")
    clock.lap("writing")
    wall, memories = clock.wall(), measure_peak_memories()
    edges = found.evidence.edges
    return Row(
        tried=len(edges),
        right=sum(edge.inliers > 0 for edge in edges),
        seconds=clock.seconds,
        wall=wall,
        memories=memories,
        quality=judge_poses(found, overlaps),
    )


class Stopwatch:
    """Processor seconds by stage; time before the first report of a stage counts for that stage."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self._start, self._last = time.monotonic(), measure_cpu()

    def progress(self, stage: str, share: float) -> None:
        """Hears of the calibration's progress; what passes before it begins to solve is averaging."""
        self.lap("averaging" if (stage, share) == ("solving", 0.0) else stage)

    def lap(self, stage: str) -> None:
        """Counts what passed since the last lap for this stage."""
        now = measure_cpu()
        self.seconds[stage] += now - self._last
        self._last = now

    def wall(self) -> float:
        """Time since the start, s."""
        return time.monotonic() - self._start


HEADER = (
    "Seconds of processors by stage and of all, seconds on the clock, most memory of the main process and of any\n"
    "other, scanners connected of those that can be, grossly wrong ones, those of them called good, and errors\n"
    f"of neighbours\n{'':9}{'pairs':>7}{'right':>7}"
    + "".join(f"{stage:>11}" for stage in (*STAGES, "all"))
    + f"{'clock':>8}{'MB':>7}{'MB':>7}{'connected':>12}{'gross':>7}{'good':>6}"
    + "".join(f"{head:>8}" for head in ("rms mm", "95 %", "max"))
)


def format_row(row: Row) -> str:
    """The row of one size."""
    seconds = "".join(f"{value:11.1f}" for value in (*row.seconds.values(), sum(row.seconds.values())))
    memories = "".join(f"{value:7.0f}" for value in row.memories)
    quality = row.quality
    connected = f"{quality.connected}/{quality.connectable}"
    errors = 1000 * quality.errors if len(quality.errors) else np.full(1, np.nan)
    spread = (np.sqrt(np.mean(errors**2)), np.quantile(errors, 0.95), errors.max())
    return (
        f"{row.tried:7d}{row.right:7d}{seconds}{row.wall:8.1f}{memories}{connected:>12}{quality.gross:7d}"
        f"{quality.confident:6d}" + "".join(f"{value:8.1f}" for value in spread)
    )


def print_exponents(rows: dict[str, Row]) -> None:
    """Prints the slope of the logarithm of the processor time over that of the number of scanners, by stage."""
    by_minutes: dict[str, list[tuple[int, Row]]] = {}
    for size, row in rows.items():
        count, minutes = size.split("x")
        by_minutes.setdefault(minutes, []).append((int(count), row))
    for minutes, found in by_minutes.items():
        if len(found) > 1:
            counts = np.log([count for count, _ in found])
            exponents = [fit_slope(counts, [row.seconds[stage] for _, row in found]) for stage in STAGES]
            exponents.append(fit_slope(counts, [sum(row.seconds.values()) for _, row in found]))
            print(f"exponent, {minutes} min".ljust(23) + "".join(f"{value:11.2f}" for value in exponents))


def fit_slope(logarithms: np.ndarray, seconds: Iterable[float]) -> float:
    """The exponent of processor times over numbers with these logarithms (K,)."""
    times = np.maximum(np.fromiter(seconds, dtype=np.float64), 1e-2)
    return float(np.polyfit(logarithms, np.log(times), 1)[0])


if __name__ == "__main__":
    main()
