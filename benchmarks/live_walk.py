"""The simulated walk of benchmarks of live sessions, and its messages with later stamps."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from calgraph.config import Rig
from calgraph.live.live_rig import list_intrinsics_topics
from calgraph.live.source import LiveMessage
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    simulate_rig,
)

LIVE = "from calgraph.cli import main; main()"
"""The program of the command line."""
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
def simulated(keep: Path | None, scenario: RigScenario = SCENARIO) -> Iterator[Path]:
    """A folder with the simulated recording."""
    with TemporaryDirectory() as temporary:
        folder = keep or Path(temporary)
        if not (folder / "recording").exists():
            simulate_rig(scenario, folder, seed=1)
        yield folder


def list_topics(rig: Rig) -> list[str]:
    """Topics of sensors and of intrinsics."""
    return [*rig.topics.values(), *(topic for one in list_intrinsics_topics(rig).values() for topic in one)]


def move(message: LiveMessage, shift: int) -> LiveMessage:
    """The message, later by a time, ns: its arrival, and the stamp of its leading header."""
    return replace(message, arrival=message.arrival + shift, data=move_stamp(message.data, shift))


def move_stamp(data: bytes, shift: int) -> bytes:
    """A serialized message (CDR) with a later stamp in its leading header, by ns."""
    stamp = int.from_bytes(data[4:8], "little") * 10**9 + int.from_bytes(data[8:12], "little")
    sec, nanosec = divmod(stamp + shift, 10**9)
    return data[:4] + sec.to_bytes(4, "little") + nanosec.to_bytes(4, "little") + data[12:]
