"""Wall time and memory of ``inspect``, ``init`` and ``calibrate`` for recordings of 1, 4 and 16 GB of one kind.

python benchmarks/long_recordings.py                                        # rests; 22 GB of temporary files
python benchmarks/long_recordings.py --case moving                          # a board that never rests
python benchmarks/long_recordings.py --case network --gigabytes 0.1 0.4 1.6
python benchmarks/long_recordings.py --gigabytes 0.1 0.2                    # small

A walk of half a minute is repeated with later stamps: a camera of 2 Mpx at 10 Hz, raw, a LiDAR of 16 beams and a
2-D scanner measure a board, or 2-D scanners two people. Peaks are those of all processes of a command.
"""

import os
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from calgraph.config.settings import LimitSettings
from calgraph.io.text_writing import save_yaml
from calgraph.io.yaml_reading import read_yaml
from calgraph.recording.bag_files import find_bag_files
from calgraph.recording.bags import BagRecording, RawMessage
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    NetworkScenario,
    RigScenario,
    SpinningOptions,
    simulate_network,
    simulate_rig,
)
from live_walk import move_stamp
from process_costs import measure_cost
from worlds import make_parser

_RESTS: Final = RigScenario(
    camera=CameraOptions(width=1600, height=1200, field_of_view=80, rate=10.0, encoding="raw"),
    laser=LaserOptions(count=1),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=1),
    bearings=(-20, -7, 7, 20),
    samples=1,
    hold_time=2.0,
    trigger=False,
)
_MOVING: Final = _RESTS.model_copy(update={"laser": LaserOptions(count=0), "hold_time": 0.05, "move_time": 2.5})
_PAUSE = 10**8
"""Between two walks, ns."""


@dataclass(frozen=True)
class Walk:
    """The messages that are repeated."""

    messages: list[RawMessage]
    rig: Path
    """rig.yaml"""

    @property
    def size(self) -> int:
        """Bytes."""
        return sum(len(message.data) for message in self.messages)

    def repeat(self, size: float) -> Iterator[RawMessage]:
        """The messages again and again, each time with later stamps, until they have ``size`` bytes."""
        first, last, shift = self.messages[0].arrival, self.messages[-1].arrival, 0
        while size > 0:
            for message in self.messages:
                yield _delay(message, shift)
                size -= len(message.data)
                if size <= 0:
                    return
            shift += last - first + _PAUSE


def main() -> None:
    """Prints a table of one row for each size and command."""
    parser = make_parser(__doc__)
    parser.add_argument("--case", choices=["rests", "moving", "network"], default="rests")
    parser.add_argument("--gigabytes", type=float, nargs="+", default=[1.0, 4.0, 16.0])
    parser.add_argument("--commands", nargs="+", default=["inspect", "init", "calibrate"])
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes of calibrate")
    arguments = parser.parse_args()
    print(f"{'GB':>6}{'messages':>10}  {'command':<10}{'wall s':>8}{'s/GB':>7}{'CPU s':>8}{'peak MB':>9}")
    with TemporaryDirectory() as name:
        scratch = Path(name)
        walk = _simulate(arguments.case, scratch / "walk")
        for size in arguments.gigabytes:
            recording = scratch / "recording"
            count = _write(walk.repeat(1e9 * size), recording)
            words: dict[str, list[object]] = {
                "inspect": [recording],
                "init": [recording, "-o", scratch / "drafted.yaml", "--force"],
                "calibrate": [walk.rig, recording, "-o", scratch / "result", "--force", "--jobs", arguments.jobs],
            }
            for command in arguments.commands:
                environment = {**os.environ, "CALGRAPH_CACHE": str(scratch / "cache")}
                start = [sys.executable, "-c", "from calgraph.cli import main; main()", command]
                cost = measure_cost([*start, *map(str, words[command])], environment)
                print(
                    f"{size:6.1f}{count:10}  {command:<10}{cost.wall:8.1f}{cost.wall / size:7.1f}{cost.cpu:8.1f}"
                    f"{cost.peak / 1e6:9.0f}",
                    flush=True,
                )
            shutil.rmtree(scratch / "cache", ignore_errors=True)
            shutil.rmtree(recording)


def _simulate(case: str, out: Path) -> Walk:
    rig = out / "rig.yaml"
    if case == "network":
        simulate_network(NetworkScenario(), out, seed=0)
    else:
        simulate_rig(_MOVING if case == "moving" else _RESTS, out, seed=0)
    if case == "moving":
        save_yaml(rig, {**read_yaml(rig), "capture": {"mode": "synchronized", "max_spread": 0.1}})
    bag = find_bag_files(out / "recording")
    assert bag
    with BagRecording(out / "recording", bag, LimitSettings()) as opened:
        messages = list(opened.raw_messages([topic.name for topic in opened.topics]))
    shutil.rmtree(out / "recording")
    return Walk(messages, rig)


def _delay(message: RawMessage, shift: int) -> RawMessage:
    return message._replace(arrival=message.arrival + shift, data=move_stamp(message.data, shift))


def _write(messages: Iterator[RawMessage], folder: Path) -> int:
    """Writes a rosbag2 folder (MCAP); the number of messages."""
    store, connections, count = get_typestore(Stores.ROS2_HUMBLE), {}, 0
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for message in messages:
            count += 1
            if message.topic not in connections:
                kind = message.definition.name
                connections[message.topic] = writer.add_connection(message.topic, kind, typestore=store)
            writer.write(connections[message.topic], message.arrival, message.data)
    return count


if __name__ == "__main__":
    main()
