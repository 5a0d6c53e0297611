"""Live sessions of networks: time until scanners are connected and within tolerance, load, and true errors.

A simulated recording is replayed through the recorder and a session; the session computes in one process.

    python benchmarks/live_network.py                      # five scanners, five minutes, five times faster
    python benchmarks/live_network.py --scanners 10 --people 4 --minutes 60 --speed 20
    python benchmarks/live_network.py --keep DIR           # the simulated recording is kept and used again
"""

import asyncio
import time
from collections.abc import Mapping
from concurrent.futures import Executor
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from calgraph.config import Rig, Tolerance, load_rig
from calgraph.geometry import Array
from calgraph.live.network_session import NetworkSession
from calgraph.live.network_solution import LiveNetworkSolution
from calgraph.live.recorder import Recorder
from calgraph.live.replay import ReplaySource
from calgraph.live.rig_session import SessionPools
from calgraph.live.source import LiveMessage
from calgraph.parallel.processes import worker_pool
from calgraph.simulation import (
    NetworkScenario,
    PeopleOptions,
    ScannerOptions,
    build_network,
    network_truth,
    simulate_network,
)
from process_costs import measure_peak_memories
from worlds import make_parser


def main() -> None:
    """Replays a recording, and prints a line for each solution."""
    parser = make_parser(__doc__)
    parser.add_argument("--scanners", type=int, default=5)
    parser.add_argument("--people", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--rate", type=float, default=15.0, help="scans per second")
    parser.add_argument("--noise", type=float, default=0.01, help="of ranges, m")
    parser.add_argument("--shape", choices=("ellipse", "legs"), default="ellipse", help="of people")
    parser.add_argument("--tolerance", type=float, default=0.01, help="m")
    parser.add_argument("--speed", type=float, default=5.0, help="of the replay")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder of the simulated recording")
    args = parser.parse_args()
    scenario = NetworkScenario(
        layout="office" if args.scanners <= 6 else "grid",
        duration=60 * args.minutes,
        scanner=ScannerOptions(count=args.scanners, rate=args.rate, range_noise=args.noise, clock_offset=0.03),
        people=PeopleOptions(count=args.people, shape=args.shape),
    )
    truth = network_truth(build_network(scenario, args.seed)).T_root_sensor
    with TemporaryDirectory() as folder, worker_pool(1) as pool:
        place = args.keep or Path(folder) / "network"
        if not (place / "rig.yaml").exists():
            simulate_network(scenario, place, args.seed)
        rig = load_rig(place / "rig.yaml")
        tolerance = Tolerance(translation=args.tolerance, rotation=rig.tolerance.rotation)
        rig = rig.model_copy(update={"tolerance": tolerance})
        source = ReplaySource(place / "recording", speed=args.speed)
        asyncio.run(replay(rig, truth, source, Path(folder) / "session", pool))
    own, other = measure_peak_memories()
    print(f"peak memory: session {own:.0f} MB, its process {other:.0f} MB")


async def replay(rig: Rig, truth: Mapping[str, Array], source: ReplaySource, folder: Path, pool: Executor) -> None:
    """Replays the recording, and prints what each solution states and how wrong it is."""
    loop = asyncio.get_running_loop()
    pools = SessionPools(pool, 1, pool, loop.call_soon_threadsafe)
    session = NetworkSession(rig, source.name, pools, folder, print)
    recorder = Recorder(folder, rig.settings.live.recorder, rig.settings.limits)
    shown: LiveNetworkSolution | None = None
    began, worked, events = time.monotonic(), 0.0, {"connected": 0.0, "done": 0.0}
    print(
        f"{'recorded':>9}{'used':>7}{'late':>6}{'took':>6}{'poses':>7}{'good':>6}{'worst σ':>9}{'error':>8}"
        f"{'NEES':>6}{'left':>6}  headline"
    )
    async for message in source.stream(list(rig.topics.values())):
        if not isinstance(message, LiveMessage):
            continue
        await recorder.write(message)
        session.feed(message)
        if session.solution is not None and session.solution is not shown:
            shown = session.solution
            worked += shown.seconds
            print_solution(shown, session, truth)
            posed = sum(one.T_root_sensor is not None for one in shown.scanners)
            for event, reached in (("connected", posed == len(rig.sensors)), ("done", shown.done)):
                if reached and not events[event]:
                    events[event] = session.timeline.latest_arrival - shown.start
    elapsed = time.monotonic() - began
    session.close()
    while session.busy:
        await asyncio.sleep(0.1)
    await recorder.close()
    for event, at in events.items():
        print(f"{event}: " + (f"after {at:.0f} s of recording" if at else "never"))
    print(f"load of the process: {100 * worked / elapsed:.0f} % of {elapsed:.0f} s")


def print_solution(shown: LiveNetworkSolution, session: NetworkSession, truth: Mapping[str, Array]) -> None:
    """One line."""
    state = session.state()
    errors, squared = measure_errors(shown, truth)
    stddevs = [one.stddev_mm for one in state.sensors if one.stddev_mm is not None]
    minutes = session.minutes_left
    recorded = session.timeline.latest_arrival - shown.start
    print(
        f"{recorded:8.0f}s{shown.used:6.0f}s{recorded - (shown.end - shown.start):5.0f}s{shown.seconds:5.1f}s"
        f"{sum(one.T_root_sensor is not None for one in shown.scanners):7d}"
        f"{sum(one.grade == 'good' for one in shown.scanners):6d}"
        f"{max(stddevs, default=np.nan):7.1f}mm{max(errors, default=np.nan):6.1f}mm"
        f"{np.mean(squared) if squared else np.nan:6.1f}"
        f"{'' if minutes is None else f'{60 * minutes:.0f}s':>6}  {state.headline[:60]}",
        flush=True,
    )


def measure_errors(shown: LiveNetworkSolution, truth: Mapping[str, Array]) -> tuple[list[float], list[float]]:
    """Position errors, mm, and their squares over the covariances, per degree of freedom."""
    errors, squared = [], []
    for one in shown.scanners:
        if one.T_root_sensor is None or one.covariance is None or not one.covariance.any():
            continue
        off = (one.T_root_sensor - truth[one.name])[:2, 3]
        errors.append(1000 * float(np.linalg.norm(off)))
        squared.append(float(off @ np.linalg.solve(one.covariance[:2, :2], off)) / 2)
    return errors, squared


if __name__ == "__main__":
    main()
