"""Feedback of a live session: time from a hold to its capture and to the poses, and load.

python benchmarks/live_feedback.py                       # five sensors, 220 MB a minute, at real time
python benchmarks/live_feedback.py --keep DIR            # the simulated recording is kept, and used again
"""

import asyncio
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from calgraph.config import Rig, load_rig
from calgraph.live.live_rig import list_intrinsics_topics
from calgraph.live.replay import ReplaySource
from calgraph.live.rig_session import RigSession, count_analysis_processes
from calgraph.live.rig_solution import solve_captures
from calgraph.live.session import SessionPools
from calgraph.live.source import LiveMessage
from calgraph.parallel.processes import worker_pool
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    load_truth,
    simulate_rig,
)
from process_costs import list_processes, measure_processor_time
from worlds import make_parser

SCENARIO = RigScenario(
    camera=CameraOptions(count=1, width=1280, height=960, rate=5.0, encoding="jpeg"),
    laser=LaserOptions(count=3),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=1, rate=5.0),
    bearings=(-60, -40, -20, -10, 0, 10, 20, 40, 60),
    radii=(1.7, 2.5),
    samples=1,
    hold_time=2.5,
    move_time=1.5,
    trigger=False,
)


@contextmanager
def simulated(keep: Path | None) -> Iterator[Path]:
    """A folder with the simulated recording."""
    with TemporaryDirectory() as temporary:
        folder = keep or Path(temporary)
        if not (folder / "recording").exists():
            simulate_rig(SCENARIO, folder, seed=1)
        yield folder


def list_topics(rig: Rig) -> list[str]:
    """Topics of sensors and of intrinsics."""
    return [*rig.topics.values(), *(topic for one in list_intrinsics_topics(rig).values() for topic in one)]


class Feedback:
    """When what the operator waits for came, s of the wall clock."""

    def __init__(self) -> None:
        self.arrived: list[tuple[float, float]] = []
        """Arrivals of messages, s, and when they were fed."""
        self.captured: list[float] = []
        self.solved: list[tuple[float, int]] = []
        """When solutions came, and from how many captures."""
        self.feeding: list[float] = []
        """Time that each message took in the main process, s."""
        self.texts: list[str] = []


async def run(
    rig: Rig, rests: list[float], recording: Path, pools: tuple[Executor, Executor], processes: int
) -> None:
    """Replays the recording to a session, and reports."""
    loop = asyncio.get_running_loop()
    feedback, size = Feedback(), 0
    session_pools = SessionPools(pools[0], processes, pools[1], loop.call_soon_threadsafe)
    session = RigSession(
        rig, str(recording), session_pools, solve_captures, exclude=print, print_line=feedback.texts.append
    )
    watching = asyncio.create_task(watch(session, feedback))
    began, processes_of_all = time.monotonic(), list_processes()
    busy = [measure_processor_time(one) for one in processes_of_all]
    async for message in ReplaySource(recording, speed=1.0).stream(list_topics(rig)):
        if isinstance(message, LiveMessage):
            size += len(message.data)
            before = time.monotonic()
            session.feed(message)
            feedback.feeding.append(time.monotonic() - before)
            feedback.arrived.append((message.arrival / 1e9, before))
    await asyncio.sleep(3.0)
    watching.cancel()
    seconds = time.monotonic() - began
    used = [measure_processor_time(one) - before for one, before in zip(processes_of_all, busy, strict=True)]
    report(session, feedback, rests, seconds, size, used)
    session.close()


async def watch(session: RigSession, feedback: Feedback) -> None:
    """Notes when captures and solutions come."""
    captures, solution = 0, None
    while True:
        now = time.monotonic()
        if len(session.taker.captures) != captures:
            captures = len(session.taker.captures)
            feedback.captured.append(now)
        if session.solution and session.solution is not solution:
            solution = session.solution
            feedback.solved.append((now, session.solution.captures))
        await asyncio.sleep(0.01)


def report(
    session: RigSession, feedback: Feedback, rests: list[float], seconds: float, size: int, used: list[float]
) -> None:
    """Prints the figures; the board rests from the stamps ``rests`` on, s."""
    holds = session.captures().holds
    arrivals, walls = (np.array(column) for column in zip(*feedback.arrived, strict=True))
    # Measurements arrive less than 20 ms after they end, which is not corrected for.
    ends = np.interp([hold.end for hold in holds], arrivals, walls)
    captured = np.array(feedback.captured) - ends
    # Holds begin up to 0.1 s before the board is at its place.
    began = [rests[int(np.argmin(np.abs(np.array(rests) - hold.start)))] for hold in holds]
    rested = np.array(feedback.captured) - np.interp(began, arrivals, walls)
    solved = [min(wall for wall, count in feedback.solved if count > i) - end for i, end in enumerate(ends)]
    print("\n".join(feedback.texts))
    print(f"{len(holds)} captures in {seconds:.0f} s, {60 * size / seconds / 1e6:.0f} MB a minute")
    print("time, s                                  median    95 %     max")
    for name, times in (
        ("from the board's rest to the capture", rested),
        ("from the end of a hold to the capture", captured),
        ("from the end of a hold to the poses", np.array(solved)),
    ):
        print(f"  {name:38s} {np.median(times):8.2f} {np.percentile(times, 95):7.2f} {times.max():7.2f}")
    feeding = 1000 * np.array(feedback.feeding)
    slow = np.percentile(feeding, 99)
    print(f"feeding a message: mean {feeding.mean():.2f}, 99 % {slow:.2f}, max {feeding.max():.1f} ms")
    print("load of main, analysis ..., solver: " + ", ".join(f"{100 * one / seconds:.0f} %" for one in used))


def main() -> None:
    """Runs the benchmark."""
    parser = make_parser(__doc__)
    parser.add_argument("--keep", type=Path, help="folder of the simulated recording")
    parser.add_argument("--processes", type=int, help="number of processes that detect")
    arguments = parser.parse_args()
    with simulated(arguments.keep) as folder:
        rig = load_rig(folder / "rig.yaml")
        processes = arguments.processes or count_analysis_processes(rig)
        rests = [board.trigger for board in load_truth(folder / "truth.yaml").boards]
        print(f"{len(rests)} holds, {processes} processes detect")
        with worker_pool(processes) as analysis, worker_pool(1) as solving:
            asyncio.run(run(rig, rests, folder / "recording", (analysis, solving), processes))


if __name__ == "__main__":
    main()
