"""Robots of benchmarks of live sessions: a simulated walk, and a process that publishes it at real time."""

import multiprocessing
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import foxglove
from rosbags.typesys import Stores, get_typestore

from calgraph.config import Rig
from calgraph.live.dds import SerializedSample, make_dds_type
from calgraph.live.live_rig import list_intrinsics_topics
from calgraph.live.source import LiveMessage
from calgraph.recording import open_recording
from calgraph.recording.bags import BagRecording
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


STORE = get_typestore(Stores.ROS2_HUMBLE)
DOMAIN = 77
LOOPBACK = (
    '<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast><Interfaces><NetworkInterface name="lo" '
    'multicast="false"/></Interfaces></General><Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer '
    'address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>'
)
"""Configuration of cyclonedds."""
Send = Callable[[bytes], object]
_LATE = 0.5
"""Messages that are due longer ago when the robot is reached are never sent, s."""


class Publisher:
    """A process that publishes a recording once it is started.

    Args:
        kind: foxglove, with stamps of now, or ros2, with those of the recording, as ``ros2 bag play`` sends it.
        recording: rosbag2 of ROS 2 types with leading headers.
        port: of a Foxglove server; 0 for any.
        online: from when on it is reached, s of ``time.monotonic``, which all processes share.
    """

    def __init__(self, kind: str, recording: Path, port: int = 0, online: float = 0.0) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._commands: Any = spawn.Queue()
        self._answers: Any = spawn.Queue()
        self._sent: Any = spawn.RawValue("q", 0)
        self._process = spawn.Process(
            target=_publish,
            args=(kind, recording, port, online, self._commands, self._answers, self._sent),
            daemon=True,
        )
        self._process.start()

    def wait_for_address(self) -> str:
        """The source of ``calgraph live``."""
        return str(self._answers.get(timeout=60))

    def start(self, begin: float) -> None:
        """Publishes the first message of the recording at a time, and the others as much later as they came."""
        self._commands.put(begin)

    @property
    def sent(self) -> int:
        """Number of messages."""
        return int(self._sent.value)

    def kill(self) -> None:
        """Ends it, without a word to its clients."""
        self._process.kill()
        self._process.join()


def _publish(kind: str, recording: Path, port: int, online: float, commands: Any, answers: Any, sent: Any) -> None:
    with open_recording(recording) as opened:
        assert isinstance(opened, BagRecording)
        topics = {topic.name: topic.type for topic in opened.topics}
        time.sleep(max(0.0, online - time.monotonic()))
        if kind == "foxglove":
            context = foxglove.Context()
            send = _make_channels(topics, context)
            server = foxglove.start_server(host="127.0.0.1", port=port, context=context)
            answers.put(f"ws://127.0.0.1:{server.port}")
        else:
            send = _serve_dds(topics)
            answers.put(f"ros2://{DOMAIN}")
        begin, first = commands.get(), opened.start
        # The messages are measured now, or were when the recording was made.
        shift = round(1e9 * (time.time() + begin - time.monotonic() - first)) if kind == "foxglove" else 0
        reached = time.monotonic()
        for message in opened.raw_messages(topics):
            due = begin + message.arrival / 1e9 - first
            if due < reached - _LATE:
                continue
            time.sleep(max(0.0, due - time.monotonic()))
            send[message.topic](move_stamp(message.data, shift))
            sent.value += 1
    commands.get()  # it is reached until it is killed


def _make_channels(topics: dict[str, str], context: foxglove.Context) -> dict[str, Send]:
    send: dict[str, Send] = {}
    for topic, name in topics.items():
        text, _ = STORE.generate_msgdef(name, ros_version=2)
        schema = foxglove.Schema(name=name, encoding="ros2msg", data=text.encode())
        send[topic] = foxglove.Channel(topic, message_encoding="cdr", schema=schema, context=context).log
    return send


class _Serialized(SerializedSample):
    """A sample that is given to cyclonedds as it was recorded."""

    def serialize(self, **_: object) -> bytes:
        return self.data


def _serve_dds(topics: dict[str, str]) -> dict[str, Send]:
    from cyclonedds.core import Policy, Qos
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    participant = DomainParticipant(DOMAIN)
    quality = Qos(Policy.Reliability.Reliable(10**9), Policy.History.KeepLast(10))
    send: dict[str, Send] = {}
    for name, kind in topics.items():
        topic = Topic(participant, f"rt{name}", make_dds_type(kind))
        writer = DataWriter(participant, topic, qos=quality)
        writer.data_type = _Serialized
        send[name] = partial(_write, writer)
    return send


def _write(writer: Any, data: bytes) -> None:
    writer.write(_Serialized(data))
