"""Time and memory of a network's whole calibration, stage by stage, against its scanners and minutes.

Each number of scanners is a grid of them, with two walkers for five, recorded as a rosbag2 folder. Seconds are of
one processor; memory is the most that the calibrating process ever held.

    python benchmarks/lrf_network.py --tables stages --sizes 6x1 30x1 100x1 6x10
"""

import multiprocessing
import tempfile
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from calgraph import calibrate as story
from calgraph.config import Rig, load_rig
from calgraph.recording import open_recordings
from calgraph.report import write_report
from calgraph.result import Calibration, save_calibration, save_captures, save_scene
from calgraph.simulation import NetworkScenario, simulate_network
from network_times import WALKERS, measure_peak_memory

STAGES = ("reading", "following", "pairing", "averaging", "solving", "assembling", "writing")
SIZES = ("6x1", "30x1", "100x1", "6x10")


def print_stages(sizes: Iterable[str]) -> None:
    """Prints the table of networks such as ``30x1``, scanners and minutes."""
    print("\nSeconds of one processor by stage, of all, and most memory")
    print(f"{'':9}{'pairs':>7}{'right':>7}" + "".join(f"{stage:>11}" for stage in (*STAGES, "all", "MB")))
    for size in sizes:
        count, minutes = (int(part) for part in size.split("x"))
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder)
            # Separate processes, so that the peak memory is that of this calibration.
            for step in (simulate, calibrate):
                with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
                    row = pool.submit(step, place, count, minutes).result()
        print(f"{size:9}{row}", flush=True)


def simulate(place: Path, count: int, minutes: int) -> str:
    """Writes the recording."""
    scenario = NetworkScenario(
        layout="grid",
        clutter=2 * count,
        duration=60.0 * minutes,
        scanner={"count": count},  # type: ignore[arg-type]
        people={"count": max(2, round(WALKERS * count))},  # type: ignore[arg-type]
    )
    simulate_network(scenario, place)
    return ""


def calibrate(place: Path, _count: int, _minutes: int) -> str:
    """Calibrates and writes all files; the row of the table."""
    rig = load_rig(place / "rig.yaml")
    clock = Stopwatch()
    with open_recordings([place / "recording"]) as recording:
        found = story.calibrate_network(rig, recording, story.NetworkOptions(), clock.progress)
    clock.lap("assembling")
    write(found, rig, place)
    clock.lap("writing")
    right = sum(edge.inliers > 0 for edge in found.evidence.edges)
    seconds = [clock.seconds.get(stage, 0.0) for stage in STAGES]
    numbers = "".join(f"{value:11.1f}" for value in (*seconds, sum(seconds)))
    return f"{len(found.evidence.edges):7d}{right:7d}{numbers}{measure_peak_memory():11.0f}"


class Stopwatch:
    """Processor seconds by stage; time before the first report of a stage counts for that stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.process_time()

    def progress(self, stage: str, share: float) -> None:
        """Hears of the calibration's progress; what passes before it begins to solve is averaging."""
        self.lap("averaging" if (stage, share) == ("solving", 0.0) else stage)

    def lap(self, stage: str) -> None:
        """Counts what passed since the last lap for this stage."""
        now = time.process_time()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now


def write(found: Calibration, rig: Rig, place: Path) -> None:
    """Writes what the command does."""
    save_calibration(found, place / "calibration.yaml")
    save_captures(found, place / "captures.csv")
    write_report(found, rig, place / "report.html")
    save_scene(found.pictures, place / "scene.npz")
