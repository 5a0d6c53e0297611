"""Feedback of a live session: time from a hold to its capture and to the poses, load, and memory.

python benchmarks/live_feedback.py                       # five sensors, 220 MB a minute, at real time
python benchmarks/live_feedback.py --keep DIR            # the simulated recording is kept, and used again
python benchmarks/live_feedback.py --processes 1 --repeat 23 --speed 8      # memory over 30 minutes
"""

import asyncio
import os
import time
from concurrent.futures import Executor
from pathlib import Path

import numpy as np

from calgraph.config import Rig, load_rig
from calgraph.live.replay import ReplaySource
from calgraph.live.rig_session import RigSession, SessionOutputs, SessionPools, count_analysis_processes
from calgraph.live.rig_solution import solve_captures
from calgraph.live.source import LiveMessage
from calgraph.parallel.processes import worker_pool
from calgraph.simulation import load_truth
from live_walk import list_topics, move, simulated
from process_costs import list_descendants, measure_memory, measure_processor_time
from worlds import make_parser

_SAMPLING_INTERVAL = 1.0
"""Between two measurements of memory and load, s."""


class Usage:
    """Memory and processor time of this process and its workers."""

    def __init__(self) -> None:
        self.peak = 0
        """Bytes of proportional memory of all together."""
        self.at: list[tuple[float, int]] = []
        self._began = time.monotonic()

    async def sample(self) -> None:
        """Samples the memory until it is cancelled."""
        while True:
            # Pages are counted in a thread: that takes 15 ms.
            total = round(await asyncio.to_thread(lambda: measure_memory(list_processes())))
            self.peak = max(self.peak, total)
            self.at.append((time.monotonic() - self._began, total))
            await asyncio.sleep(_SAMPLING_INTERVAL)


def list_processes() -> list[int]:
    """This process and those that it has started."""
    return [os.getpid(), *list_descendants(os.getpid())]


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
    rig: Rig,
    rests: list[float],
    recording: Path,
    pools: tuple[Executor, Executor],
    processes: int,
    repeat: int,
    speed: float,
) -> None:
    """Replays the recording to a session, and reports."""
    loop = asyncio.get_running_loop()
    feedback, usage = Feedback(), Usage()
    session_pools = SessionPools(pools[0], processes, pools[1], loop.call_soon_threadsafe)
    session = RigSession(rig, str(recording), session_pools, SessionOutputs(lambda _: None), solve_captures)
    watching = asyncio.create_task(watch(session, feedback))
    sampling = asyncio.create_task(usage.sample())
    began, busy = time.monotonic(), [measure_processor_time(pid) for pid in list_processes()]
    shift, size = 0, 0
    for _ in range(repeat):
        last = 0
        async for message in ReplaySource(recording, speed=speed).stream(list_topics(rig)):
            if isinstance(message, LiveMessage):
                moved = move(message, shift)
                last = max(last, moved.arrival)
                size += len(moved.data)
                before = time.monotonic()
                session.feed(moved)
                feedback.feeding.append(time.monotonic() - before)
                feedback.arrived.append((moved.arrival / 1e9, before))
        shift = last - first_arrival(feedback) + 10**8
    await asyncio.sleep(3.0)
    for task in (watching, sampling):
        task.cancel()
    seconds = time.monotonic() - began
    used = [measure_processor_time(pid) - before for pid, before in zip(list_processes(), busy, strict=True)]
    report(session, feedback, usage, rests, seconds, size, used)
    session.close()


def first_arrival(feedback: Feedback) -> int:
    """Of all messages, ns."""
    return round(feedback.arrived[0][0] * 1e9)


async def watch(session: RigSession, feedback: Feedback) -> None:
    """Notes when captures and solutions come."""
    number, captures, solutions = 0, 0, 0
    while True:
        state = session.state()
        now = time.monotonic()
        if state.event.number != number:
            number = state.event.number
            feedback.texts.append(state.event.text)
        if state.captures != captures:
            captures = state.captures
            feedback.captured.append(now)
        if session.solution and session.solutions != solutions:
            solutions = session.solutions
            feedback.solved.append((now, session.solution.captures))
        await session.wait_for_change(state)


def report(
    session: RigSession,
    feedback: Feedback,
    usage: Usage,
    rests: list[float],
    seconds: float,
    size: int,
    used: list[float],
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
    half = [total for at, total in usage.at if at > seconds / 2]
    print(f"memory: peak {usage.peak / 1e6:.0f} MB, median of the second half {np.median(half) / 1e6:.0f} MB")


def main() -> None:
    """Runs the benchmark."""
    parser = make_parser(__doc__)
    parser.add_argument("--keep", type=Path, help="folder of the simulated recording")
    parser.add_argument("--processes", type=int, help="number of processes that detect")
    parser.add_argument("--repeat", type=int, default=1, help="number of times that it is replayed")
    parser.add_argument("--speed", type=float, default=1.0, help="of the replay")
    arguments = parser.parse_args()
    with simulated(arguments.keep) as folder:
        rig = load_rig(folder / "rig.yaml")
        processes = arguments.processes or count_analysis_processes(rig)
        rests = [board.trigger for board in load_truth(folder / "truth.yaml").boards]
        print(f"{len(rests)} holds, {processes} processes detect")
        with worker_pool(processes) as analysis, worker_pool(1) as solving:
            asyncio.run(
                run(
                    rig,
                    rests,
                    folder / "recording",
                    (analysis, solving),
                    processes,
                    arguments.repeat,
                    arguments.speed,
                )
            )


if __name__ == "__main__":
    main()
