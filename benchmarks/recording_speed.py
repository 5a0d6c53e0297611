"""Time and memory that ``calgraph calibrate`` takes for a recording, start of the interpreter included.

python benchmarks/recording_speed.py                        # simulates five sensors, 170 s, 200 MB
python benchmarks/recording_speed.py --rig RIG.yaml --recording DIR --jobs 1 2 4   # bits compared
"""

import argparse
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from calgraph.recording import open_recording
from calgraph.simulation import RigScenario, simulate_rig


@dataclass(frozen=True)
class Cost:
    """What one run of the command took."""

    wall: float
    """s."""
    cpu: float
    """s, user and system, of all threads."""
    peak: float
    """Largest resident set of one process, bytes."""


def main() -> None:
    """Prints a table of one row for each run, and a verdict."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", type=Path, help="simulated if left out")
    parser.add_argument("--rig", type=Path, help="of the recording; rig.yaml beside it if left out")
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--jobs", type=int, nargs="+", default=[os.cpu_count() or 1], help="numbers of processes")
    arguments = parser.parse_args()
    with TemporaryDirectory() as scratch:
        if arguments.recording is None:
            simulate_rig(RigScenario(), Path(scratch) / "rig", seed=0)
        recording = arguments.recording or Path(scratch) / "rig" / "recording"
        rig = arguments.rig or recording.parent / "rig.yaml"
        with open_recording(recording) as opened:
            length = opened.end - opened.start
        size = sum(file.stat().st_size for file in [recording, *recording.rglob("*")] if file.is_file())
        print(f"{recording}: {length:.0f} s, {size / 1e6:.0f} MB; {os.cpu_count()} cores, load {_load()}")
        print(f"{'jobs':>4}{'wall s':>8}{'of length':>11}{'CPU s':>8}{'of length':>11}{'peak MB':>9}")
        costs, results = [], set()
        for run, jobs in enumerate(arguments.jobs * arguments.runs):
            out = Path(scratch) / f"result{run}"
            costs.append(_cost_of_calibrating(rig, recording, out, jobs))
            print(f"{jobs:4}{_row(costs[-1], length)}", flush=True)
            results.add((out / "calibration.yaml").read_text().partition("\nprovenance:")[0])
    print(f"bits of the {len(costs)} results: {'identical' if len(results) == 1 else 'DIFFERENT'}")
    best = min(costs, key=lambda cost: cost.wall)
    met = best.wall <= length / 4 and best.peak < 1.5e9
    print(f"{'within' if met else 'NOT within'} a quarter of the recording's length and 1.5 GB")


def _cost_of_calibrating(rig: Path, recording: Path, out: Path, jobs: int) -> Cost:
    command = [sys.executable, "-c", "from calgraph.cli import main; main()", "calibrate"]
    command += [str(rig), str(recording), "-o", str(out), "--jobs", str(jobs)]
    began = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    # wait4 returns the usage of this one process; the sum over all children would mix the runs.
    _, status, usage = os.wait4(process.pid, 0)
    wall = time.perf_counter() - began
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        sys.exit(f"calgraph calibrate failed with exit code {process.returncode}")
    unit = 1 if sys.platform == "darwin" else 1024
    return Cost(wall, usage.ru_utime + usage.ru_stime, unit * usage.ru_maxrss)


def _row(cost: Cost, length: float) -> str:
    shares = cost.wall / length, cost.cpu / length
    return f"{cost.wall:8.1f}{shares[0]:11.3f}{cost.cpu:8.1f}{shares[1]:11.3f}{cost.peak / 1e6:9.0f}"


def _load() -> str:
    return f"{os.getloadavg()[0]:.1f}"


if __name__ == "__main__":
    main()
