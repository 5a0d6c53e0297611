"""Recorders of live sessions that are killed at random moments: whether what they wrote is there.

python benchmarks/live_kills.py              # 20 kills at 20 MB/s
"""

import argparse
import asyncio
import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from calgraph.config.settings import LimitSettings, RecorderSettings
from calgraph.live.recorder import Recorder
from calgraph.live.source import Channel, LiveMessage
from calgraph.recording import open_recording

_CHANNEL = Channel("/image", "test_msgs/msg/Bytes", "cdr", "ros2msg", "uint8[] data\n")
_SIZE = 200_000
_PERIOD = 0.01


def main() -> None:
    """Prints a row for each kill; exit code 1 if more than a second was lost, or a message before."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--record", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.record:
        asyncio.run(_record(arguments.record))
    logging.disable()  # each recording is warned of, as it has no end
    rng = np.random.default_rng(0)
    print("| killed after | sent | recorded | lost at the end, s | missing before |")
    print("| ---: | ---: | ---: | ---: | ---: |")
    worst, missing = 0.0, 0
    with TemporaryDirectory(prefix="kills ") as name:
        for number in range(arguments.kills):
            folder = Path(name) / str(number)
            delay = rng.uniform(0.6, 4.0)
            killed, sent = _kill(folder, delay)
            with open_recording(folder) as recording:
                arrivals = [round(record.arrival * 1e9) for record in recording.records()]
            lost = killed - arrivals[-1] / 1e9
            numbers = sent[: len(arrivals)]
            wrong = sum(abs(a - b) > 1000 for a, b in zip(arrivals, numbers, strict=False))
            worst, missing = max(worst, lost), missing + wrong
            print(f"| {delay:.2f} s | {len(sent)} | {len(arrivals)} | {lost:.2f} | {wrong} |", flush=True)
    print(f"\nat most {worst:.2f} s lost at the end; {missing} messages missing before")
    raise SystemExit(worst > 1 or missing > 0)


def _kill(folder: Path, delay: float) -> tuple[float, list[int]]:
    """The time of a kill, s, and the arrivals of all messages that were given to the recorder, ns."""
    process = subprocess.Popen(
        [sys.executable, __file__, "--record", str(folder)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout
    first = process.stdout.readline()
    time.sleep(delay)
    killed = time.time()
    os.kill(process.pid, signal.SIGKILL)
    sent = [int(line) for line in [first, *process.stdout] if line.endswith("\n")]
    process.wait()
    process.stdout.close()
    return killed, sent


async def _record(folder: Path) -> None:
    recorder = Recorder(folder, RecorderSettings(), LimitSettings(min_free_disk=0))
    data = b"\0\1\0\0" + (_SIZE).to_bytes(4, "little") + bytes(_SIZE)
    while True:
        message = LiveMessage(_CHANNEL, time.time_ns(), data[:-1] + data[-1:])
        await recorder.write(message)
        print(message.arrival, flush=True)
        await asyncio.sleep(_PERIOD)


if __name__ == "__main__":
    main()
