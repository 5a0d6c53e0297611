"""Memory of ``calgraph live`` over half an hour of 220 MB a minute, and messages that it did not record.

The simulated recording of live_feedback.py is repeated with later stamps, and replayed to the command.

python benchmarks/live_memory.py --keep DIR                 # 30 minutes at real time; 7 GB in DIR
python benchmarks/live_memory.py --keep DIR --repeat        # with hundreds of captures
taskset -c 0,1 python benchmarks/live_memory.py --keep DIR  # on two cores
"""

import asyncio
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from calgraph.config import load_rig
from calgraph.live.recorder import Recorder
from calgraph.live.replay import ReplaySource
from calgraph.live.source import LiveMessage
from calgraph.recording import open_recording
from live_walk import LIVE, list_topics, move, simulated
from process_costs import list_descendants, measure_memory
from worlds import make_parser

_COMMAND = [sys.executable, "-c", LIVE, "live", "--port", "0"]
_SAMPLING_INTERVAL = 1.0
"""Between two measurements of memory, s."""


def main() -> None:
    """Prints memory and messages."""
    parser = make_parser(__doc__)
    parser.add_argument("--keep", type=Path, required=True, help="folder of recordings and of the session")
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--speed", type=float, default=1.0, help="of the replay")
    parser.add_argument("--repeat", action="store_true", help="captures of poses that have been captured, too")
    arguments = parser.parse_args()
    folder = arguments.keep
    with simulated(folder) as walk:
        long = folder / "long"
        if not long.exists():
            asyncio.run(repeat(walk, long, arguments.minutes))
    options = ["--source", long, "-o", folder / f"session {time.time():.0f}", "--speed", arguments.speed]
    if arguments.repeat:
        # Far less than noise moves the detected board.
        options += ["--set", "live.capture.min_distance=1e-6", "--set", "live.capture.min_angle=1e-6"]
    command = [*_COMMAND, *map(str, [folder / "rig.yaml", *options])]
    samples: list[tuple[float, int]] = []
    began = time.monotonic()
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout
        lines: list[str] = []
        for line in process.stdout:  # until the final calibration begins, which another benchmark measures
            lines.append(line)
            if line.startswith("Open "):
                sample(process, samples, began)
        print("".join(lines[-60:]))
    times, memory = np.array([one for one, _ in samples]), np.array([one for _, one in samples]) / 1e6
    print(f"memory, MB: peak {memory.max():.0f}; medians of sixths:", end="")
    for part in np.array_split(np.arange(len(times)), 6):
        print(f" {np.median(memory[part]):.0f}", end="")
    print(f"; over {times[-1] / 60:.1f} min")
    print(f"sent {count_messages(long)}, recorded {count_messages(Path(options[3]) / 'recording')}")


async def repeat(walk: Path, long: Path, minutes: float) -> None:
    """Records the walk again and again, each time with later stamps."""
    rig = load_rig(walk / "rig.yaml")
    recorder = Recorder(long, rig.settings.live.recorder, rig.settings.limits)
    first = last = shift = 0
    while last - first < 60e9 * minutes:
        async for message in ReplaySource(walk / "recording", speed=0).stream(list_topics(rig)):
            if isinstance(message, LiveMessage):
                moved = move(message, shift)
                first, last = first or moved.arrival, max(last, moved.arrival)
                await recorder.write(moved)
        shift = last - first + 10**8
    await recorder.close()


def sample(process: subprocess.Popen[str], samples: list[tuple[float, int]], began: float) -> None:
    """Samples the memory of the command and its workers until the final calibration begins."""
    while process.poll() is None:
        processes = [process.pid, *list_descendants(process.pid)]
        if any("calibrate" in read_command(one) for one in processes[1:]):
            return
        samples.append((time.monotonic() - began, round(measure_memory(processes))))
        time.sleep(_SAMPLING_INTERVAL)


def read_command(process: int) -> str:
    """Arguments of a process; empty if it has ended."""
    try:
        return Path(f"/proc/{process}/cmdline").read_text()
    except OSError:
        return ""


def count_messages(recording: Path) -> int:
    """Number of messages of sensors and intrinsics."""
    with open_recording(recording) as opened:
        return sum(topic.count for topic in opened.topics if topic.name != "/calgraph/trigger")


if __name__ == "__main__":
    main()
