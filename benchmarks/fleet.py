"""A fleet of simulated robots: which moved sensors are named, and what a kill and four processes cost.

python benchmarks/fleet.py --keep /tmp/fleet                 # 50 robots; recordings are made once, in 20 minutes
python benchmarks/fleet.py --keep /tmp/fleet --timed 8       # the time per robot in one process and in four
python benchmarks/fleet.py --keep /tmp/fleet --seed 1 --robots 12 --broken 1 --moved 2

Three recordings are broken, and one sensor of each of five other robots is moved by 10 mm in a random direction
between its two recordings. The run is killed (SIGKILL, no time to clean up) when a third of the recordings is
done, and then goes on.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fleet_data import FleetPlan, plan_fleet, save_fleet, write_fleet
from worlds import make_parser

_COMMAND = [sys.executable, "-c", "from calgraph.cli import main; main()", "fleet"]
_POLL = 0.2
"""Interval at which finished recordings are counted, s."""


def start(fleet: Path, out: Path, jobs: int) -> "subprocess.Popen[str]":
    """Starts ``calgraph fleet``, without a cache."""
    command = [*_COMMAND, str(fleet), "-o", str(out), "--jobs", str(jobs), "--json"]
    environment = {**os.environ, "CALGRAPH_CACHE": "off"}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment)


def finish(process: "subprocess.Popen[str]") -> Mapping[str, Any]:
    """The results by robot of a run."""
    output, _ = process.communicate()
    robots: Mapping[str, Any] = json.loads(output)["robots"]
    return robots


def list_results(out: Path) -> dict[Path, int]:
    """The recordings that are done, with the time of their last change, ns."""
    return {path: path.stat().st_mtime_ns for path in out.glob("robots/*/*/recording.json")}


def kill_and_resume(fleet: Path, out: Path, count: int, jobs: int) -> Mapping[str, Any]:
    """Runs a fleet, kills the run after a third of ``count`` recordings, and goes on with it."""
    began = time.monotonic()
    with start(fleet, out, jobs) as process:
        while len(list_results(out)) < count // 3 and process.poll() is None:
            time.sleep(_POLL)
        process.kill()
        process.communicate()
    killed = time.monotonic()
    before = list_results(out)
    with start(fleet, out, jobs) as process:
        robots = finish(process)
    after = list_results(out)
    repeated = sum(after[path] != changed for path, changed in before.items())
    print(
        f"killed after {killed - began:.0f} s with {len(before)} of {count} recordings done; the rest took "
        f"{time.monotonic() - killed:.0f} s; {repeated} repeated of those that were done, {len(after)} done"
    )
    return robots


def show_results(plan: FleetPlan, robots: Mapping[str, Any]) -> int:
    """Prints what is named and what failed; returns the number of robots with another result than expected."""
    wrong = 0
    for name in plan.robots:
        moved = list(robots[name]["moved"])
        failed = [failure["recording"] for failure in robots[name]["failures"]]
        expected = [plan.moved[name]] if name in plan.moved else []
        named = [" or ".join(move["sensors"]) for move in moved]
        warnings = robots[name]["warnings"]
        if named != expected or bool(failed or warnings) != (name in plan.broken):
            wrong += 1
            print(f"NOT AS EXPECTED: {name}: named {named}, moved {expected}; failed {failed}")
        for move in moved:
            print(
                f"{name}: {' or '.join(move['sensors'])} {1000 * move['distance']:.1f} ± "
                f"{1000 * move['distance_stddev']:.1f} mm; {plan.moved.get(name, 'nothing')} was moved"
            )
        for of_recording in warnings.values():
            print(f"{name}: {plan.broken.get(name)}: warning: {of_recording[0]}")
        for failure in robots[name]["failures"]:
            print(f"{name}: {plan.broken.get(name)}: {failure['kind']}: {failure['message'].splitlines()[0]}")
    others = [name for name in plan.robots if name not in plan.moved]
    alarms = sum(bool(robots[name]["moved"]) for name in others)
    found = sum(bool(robots[name]["moved"]) for name in plan.moved)
    print(
        f"{found} of {len(plan.moved)} robots with a moved sensor named; false alarms: {alarms} of {len(others)}"
    )
    return wrong


def show_times(folder: Path, robots: Sequence[str], out: Path) -> None:
    """Prints the time per robot in one process and in four."""
    fleet = folder / "timed.yaml"
    save_fleet(fleet, robots)
    times = {}
    for jobs in (1, 4):
        shutil.rmtree(out, ignore_errors=True)
        load, began = os.getloadavg()[0], time.monotonic()
        with start(fleet, out, jobs) as process:
            finish(process)
        times[jobs] = (time.monotonic() - began) / len(robots)
        print(f"{jobs} processes: {times[jobs]:.1f} s per robot of two recordings (load before: {load:.1f})")
    print(f"ratio: {times[4] / times[1]:.2f}")


def main() -> None:
    """Makes the fleet, runs it, and prints the results."""
    parser = make_parser(__doc__)
    parser.add_argument("--keep", type=Path, required=True, help="folder of recordings, made if they are missing")
    parser.add_argument("--robots", type=int, default=50)
    parser.add_argument("--broken", type=int, default=3)
    parser.add_argument("--moved", type=int, default=5)
    parser.add_argument("--distance", type=float, default=0.01, help="by which sensors are moved, m")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=4)
    parser.add_argument("--timed", type=int, default=0, help="robots of which the time is measured")
    arguments = parser.parse_args()
    plan = plan_fleet(arguments.robots, arguments.broken, arguments.moved, arguments.seed)
    write_fleet(plan, arguments.keep, arguments.seed, arguments.distance)
    with tempfile.TemporaryDirectory(dir=arguments.keep) as temporary:
        out = Path(temporary)
        if arguments.timed:
            sound = [name for name in plan.robots if name not in plan.broken]
            show_times(arguments.keep, sound[: arguments.timed], out / "timed")
            return
        fleet, count = arguments.keep / "fleet.yaml", 2 * len(plan.robots)
        robots = kill_and_resume(fleet, out / "whole", count, arguments.jobs)
        page = out / "whole" / "index.html"
        print(f"overview: {page.stat().st_size / 1000:.0f} kB")
        wrong = show_results(plan, robots)
        shutil.rmtree(arguments.keep / "out", ignore_errors=True)
        (out / "whole").rename(arguments.keep / "out")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
