"""The recorder of live sessions: messages lost, memory, throughput, and pauses of the event loop.

python benchmarks/live_recorder.py                    # 5 simulated minutes of 220 MB, as fast as possible
python benchmarks/live_recorder.py --minutes 30       # 6.6 GB
python benchmarks/live_recorder.py --ros1             # messages of ROS 1, which are converted
"""

import argparse
import asyncio
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from calgraph.config.settings import LimitSettings, RecorderSettings
from calgraph.live.recorder import Recorder
from calgraph.live.source import Channel, LiveMessage
from calgraph.recording import open_recording

# Sensor, rate in Hz, points or bytes: together 220 MB a minute.
_CLOUDS = (("/points", 10.0, 16_000),)
_IMAGES = (("/camera/image_raw/compressed", 10.0, 100_000),)
_SCANS = (("/laser_front/scan", 25.0, 720), ("/laser_left/scan", 25.0, 720), ("/laser_right/scan", 25.0, 720))


def main() -> None:
    """Prints the figures; exit code 1 if a message is lost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--ros1", action="store_true")
    parser.add_argument("--folder", type=Path, help="on the disk to measure; temporary files otherwise")
    arguments = parser.parse_args()
    with TemporaryDirectory(prefix="recorder ", dir=arguments.folder) as name:
        sent = asyncio.run(_record(Path(name), arguments.minutes, ros1=arguments.ros1))
        with open_recording(Path(name)) as recording:
            found = sum(1 for _ in recording.records())
    print(f"{sent} messages sent, {sent - found} lost")
    raise SystemExit(sent != found)


async def _record(folder: Path, minutes: float, *, ros1: bool) -> int:
    recorder = Recorder(folder, RecorderSettings(), LimitSettings())
    pauses = asyncio.create_task(_measure_pauses())
    began, sent, share = time.perf_counter(), 0, 0.0
    for message in _simulate(minutes, ros1=ros1):
        await recorder.write(message)
        sent += 1
        if sent % 20 == 0:
            await asyncio.sleep(0)  # as a source does between two packets
        seconds = message.arrival / 1e9
        for step in (0.1, 0.5, 1.0):
            if share < step <= seconds / (60 * minutes) + 1e-3:
                share = step
                print(f"{100 * step:3.0f} %: {_resident_megabytes():.0f} MB of memory", flush=True)
    await recorder.close()
    duration, state = time.perf_counter() - began, recorder.state
    pauses.cancel()
    print(
        f"{state.megabytes:.0f} MB in {duration:.1f} s: {state.megabytes / duration:.0f} MB/s; "
        f"longest pause of the event loop {1000 * max(_PAUSES):.0f} ms; {state.problem or 'no problem'}"
    )
    return sent


_PAUSES = [0.0]


async def _measure_pauses() -> None:
    """How much later than asked for the event loop continues, s."""
    while True:
        before = time.perf_counter()
        await asyncio.sleep(0.005)
        _PAUSES.append(time.perf_counter() - before - 0.005)


def _resident_megabytes() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def _simulate(minutes: float, *, ros1: bool) -> Iterator[LiveMessage]:
    """Messages in order of arrival."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    streams = [
        (topic, rate, kind, size)
        for kind, sensors in (("PointCloud2", _CLOUDS), ("CompressedImage", _IMAGES), ("LaserScan", _SCANS))
        for topic, rate, size in sensors
    ]
    prepared = []
    for topic, rate, kind, size in streams:
        name = f"sensor_msgs/msg/{kind}"
        message = _make_message(store.types, kind, size, ros1=ros1)
        data = bytes(store.serialize_ros1(message, name) if ros1 else store.serialize_cdr(message, name))
        text, _ = store.generate_msgdef(name, ros_version=1 if ros1 else 2)
        channel = Channel(topic, name, "ros1" if ros1 else "cdr", "ros1msg" if ros1 else "ros2msg", text)
        prepared.append((rate, channel, data))
    times = sorted(
        (int(1e9 * k / rate), i)
        for i, (rate, _, _) in enumerate(prepared)
        for k in range(int(60 * minutes * rate))
    )
    for arrival, i in times:
        _, channel, data = prepared[i]
        # A separate copy, as each message of a source is.
        yield LiveMessage(channel, arrival, data[:-1] + data[-1:])


def _make_message(types: Mapping[str, Any], kind: str, size: int, *, ros1: bool) -> Any:
    rng = np.random.default_rng(0)
    stamp = types["builtin_interfaces/msg/Time"](1, 0)
    header = types["std_msgs/msg/Header"](*([0] if ros1 else []), stamp, "sensor")
    make = types[f"sensor_msgs/msg/{kind}"]
    if kind == "LaserScan":
        ranges = rng.uniform(1, 10, size).astype(np.float32)
        return make(header, -1.0, 1.0, 0.003, 0.0, 0.04, 0.1, 30.0, ranges, np.zeros(0, np.float32))
    if kind == "CompressedImage":
        return make(header, "jpeg", rng.integers(0, 256, size, np.uint8))
    field = types["sensor_msgs/msg/PointField"]
    fields = [field(name, 4 * i, 7, 1) for i, name in enumerate("xyz")]
    return make(header, 1, size, fields, False, 16, 16 * size, rng.integers(0, 256, 16 * size, np.uint8), True)


if __name__ == "__main__":
    main()
