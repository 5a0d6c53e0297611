"""calgraph live: replayed recordings become sessions, which are resumed, interrupted, finished, and calibrated."""

import asyncio
import json
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import Result

from calgraph.io.yaml_reading import read_yaml
from calgraph.recording import open_recording
from calgraph.result import load_calibration
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    simulate_rig,
)

pytest.importorskip("starlette", reason="the extra live is not installed")
pytestmark = pytest.mark.slow

Run = Callable[..., Result]
PATIENCE = 60.0
"""s; waited in failing tests only."""
HOLDS = 3


@pytest.fixture(scope="session")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """rig.yaml and recording of three holds in 11 s; not to be changed."""
    folder = tmp_path_factory.mktemp("walks") / "a walk"
    scenario = RigScenario(
        background=3.0,
        bearings=(-20, 0, 20),
        radii=(1.7,),
        samples=1,
        hold_time=1.9,
        move_time=0.6,
        trigger=False,
        clutter=4,
        camera=CameraOptions(count=1, width=480, height=360, rate=4.0, texels_per_mm=1.0),
        laser=LaserOptions(count=1, rate=10, resolution=0.5),
        spinning=SpinningOptions(count=0),
        multibeam=MultibeamOptions(count=1, rate=5, resolution=0.8),
    )
    simulate_rig(scenario, folder, seed=3)
    return folder


COMMAND = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of shells ignore it
from calgraph.cli import main
main()
"""
PAUSED = """
import asyncio
from calgraph.live.replay import ReplaySource
from calgraph.live.source import LiveMessage
stream = ReplaySource.stream
async def stream_until_pause(self, topics):
    first = None
    async for item in stream(self, topics):
        if isinstance(item, LiveMessage):
            first = first or item.arrival
            if item.arrival - first > 8e9:
                await asyncio.sleep(600)
        yield item
ReplaySource.stream = stream_until_pause
"""
"""Precedes a command whose source pauses in the third hold, so that tests need not hurry."""


class Live:
    """A running command, and the lines that it has printed until now."""

    def __init__(self, *arguments: object, command: str = COMMAND) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", command, "live", *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            encoding="utf-8",
        )
        self.lines: list[str] = []
        self.exit_code: int | None = None

    def wait_for(self, text: str) -> str:
        """The next line with the text."""
        assert self._process.stdout
        for line in self._process.stdout:
            self.lines.append(line.rstrip("\n"))
            if text in line:
                return line
        raise AssertionError(f"{text!r} was not printed, but:\n" + "\n".join(self.lines))

    def signal(self, number: int) -> None:
        self._process.send_signal(number)

    def wait(self) -> int:
        """The exit code."""
        assert self._process.stdout
        with self._process.stdout as rest:
            self.lines += rest.read().splitlines()
        return self._process.wait(PATIENCE)

    @property
    def captures(self) -> list[str]:
        return [line for line in self.lines if line.startswith("Capture ")]


def start(walk: Path, session: Path, *arguments: object, command: str = COMMAND) -> Live:
    """A session that replays the walk as fast as nothing is skipped, so that it does not depend on the machine."""
    options = ("--source", walk / "recording", "-o", session, "--speed", 0, "--port", 0)
    return Live(walk / "rig.yaml", *options, *arguments, command=command)


@pytest.fixture(scope="session")
def session(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Live]:
    """A session that the end of its source has ended; not to be changed."""
    folder = tmp_path_factory.mktemp("sessions") / "whole session"
    live = start(walk, folder)
    live.exit_code = live.wait()
    return folder, live


def test_a_replayed_walk_is_captured_and_calibrated(session: tuple[Path, Live]) -> None:
    folder, live = session
    assert live.exit_code in {0, 1}, live.lines
    assert len(live.captures) == HOLDS
    assert len(load_calibration(folder / "result" / "calibration.yaml").evidence.captures) > 0
    assert (folder / "result" / "report.html").is_file()


def test_every_message_is_recorded(walk: Path, session: tuple[Path, Live]) -> None:
    with open_recording(walk / "recording") as source, open_recording(session[0] / "recording") as recorded:
        counts = {topic.name: topic.count for topic in recorded.topics}
        assert counts.pop("/calgraph/trigger") == HOLDS
        assert counts == {topic.name: topic.count for topic in source.topics if topic.name in counts}
        assert len(counts) == 4  # with the intrinsics


def test_calibrating_the_recording_gives_the_same_to_the_bit(
    run: Run, session: tuple[Path, Live], tmp_path: Path
) -> None:
    folder, _ = session
    run("calibrate", folder / "rig.yaml", folder / "recording", "-o", tmp_path)
    files = ("residuals.csv", "captures.csv", "budget.csv", "rig.resolved.yaml")
    for file in files:
        assert (tmp_path / file).read_bytes() == (folder / "result" / file).read_bytes()
    again, before = (read_yaml(one / "calibration.yaml") for one in (tmp_path, folder / "result"))
    assert again.pop("provenance") != before.pop("provenance")
    assert again == before


def test_a_killed_session_goes_on(walk: Path, session: tuple[Path, Live], tmp_path: Path) -> None:
    chunks = ("--set", "live.recorder.max_chunk_duration=0.02")
    killed = start(walk, tmp_path / "session", *chunks, command=PAUSED + COMMAND)
    killed.wait_for("Capture 2")
    time.sleep(0.3)  # what is not written yet is lost, such as the trigger of the capture
    killed.signal(signal.SIGKILL)
    killed.wait()
    resumed = Live("--resume", tmp_path / "session", "--speed", 0, "--port", 0)
    resumed.wait()
    numbers = [line.split(":")[0] for line in resumed.captures]
    assert numbers[-1] == f"Capture {HOLDS}"
    assert "Capture 1" not in numbers
    with open_recording(tmp_path / "session" / "recording") as recording:
        counts = {topic.name: topic.count for topic in recording.topics}
    with open_recording(session[0] / "recording") as recording:
        whole = {topic.name: topic.count for topic in recording.topics}
    del counts["/calgraph/trigger"], whole["/calgraph/trigger"]
    # A replay goes on after the last arrival, which an image and its intrinsics may share.
    assert sum(whole.values()) - sum(counts.values()) in {0, 1}


def test_ctrl_c_keeps_what_was_recorded_and_says_how_to_go_on(walk: Path, tmp_path: Path) -> None:
    live = start(walk, tmp_path / "my session", command=PAUSED + COMMAND)
    live.wait_for("Capture 1")
    live.signal(signal.SIGINT)
    time.sleep(0.02)
    live.signal(signal.SIGINT)  # as people press it twice
    assert live.wait() == 130
    assert f"calgraph live --resume '{tmp_path / 'my session'}'" in live.lines[-1]
    assert (tmp_path / "my session" / "recording" / "metadata.yaml").is_file()


def test_the_operator_finishes_and_reads_the_report_on_the_page(walk: Path, tmp_path: Path) -> None:
    from websockets.asyncio.client import connect
    from websockets.typing import Origin

    live = start(walk, tmp_path / "session", "--manual", command=PAUSED + COMMAND)
    address = live.wait_for("Open http://").split()[1]

    async def finish_after_one_capture() -> None:
        async with connect(f"ws{address[4:]}state", origin=Origin(address.rstrip("/"))) as socket:
            state: dict[str, Any] = {}
            wanted = 0
            async for text in socket:
                state |= json.loads(text)
                if state["report"]:
                    return
                if state["captures"]:
                    await socket.send("finish")
                elif state["phase"] == "ready" and wanted <= state["event"]["number"]:
                    wanted += 1
                    await socket.send("trigger")

    asyncio.run(asyncio.wait_for(finish_after_one_capture(), PATIENCE))
    with urllib.request.urlopen(f"{address}report") as answer:
        assert b"<title>" in answer.read()
    live.signal(signal.SIGINT)
    assert live.wait() in {0, 1}


def test_a_replayed_network_is_calibrated(run: Run, tmp_path: Path) -> None:
    walk, session = tmp_path / "walk", tmp_path / "session"
    options = "--duration 15 --scanner-count 3 --scanner-rate 10 --scanner-resolution 0.5"
    assert run("simulate", "network", "-o", walk, *options.split()).exit_code == 0
    live = Live(
        walk / "rig.yaml", "--source", walk / "recording", "-o", session, "--speed", 0, "--port", 0,
        "--set", "live.network.first=4",
    )  # fmt: skip
    assert live.wait() == 0, live.lines
    assert len(load_calibration(session / "result" / "calibration.yaml").sensors) == 3


def test_a_session_without_captures_says_so_and_is_not_calibrated(walk: Path, tmp_path: Path) -> None:
    source = ("--source", walk / "recording", "-o", tmp_path / "session")
    live = Live(walk / "rig.yaml", *source, "--speed", 0, "--port", 0, "--manual")
    assert live.wait() == 1
    assert live.lines[-1].startswith("No capture was taken")
    assert not (tmp_path / "session" / "result").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "RIG.yaml, --source, -o: missing"),
        (["{walk}/rig.yaml", "-o", "{out}"], "--source: missing"),
        (["{walk}/rig.yaml", "--resume", "{out}"], "RIG.yaml: not with --resume"),
        (["{walk}/rig.yaml", "--source", "no such recording", "-o", "{out}"], "is neither an address nor an"),
        (["{walk}/rig.yaml", "--source", "ws://robot:8765", "-o", "{out}", "--speed", "2"], "only for recordings"),
    ],
)
def test_mistakes_are_refused_before_anything_is_written(
    run: Run, walk: Path, tmp_path: Path, arguments: list[str], message: str
) -> None:
    out = tmp_path / "session"
    result = run("live", *(argument.format(walk=walk, out=out) for argument in arguments))
    assert result.exit_code == 2
    assert message in result.stderr
    assert not out.exists()


def test_a_drive_is_recorded_and_calibrated(run: Run, tmp_path: Path) -> None:
    run(
        "simulate",
        "drive",
        "-o",
        tmp_path / "drive",
        "--rig",
        "two_scanners",
        "--path",
        "planar",
        "--duration",
        14,
    )
    live = start(tmp_path / "drive", tmp_path / "session")
    assert live.wait() in {0, 1}, live.lines
    with open_recording(tmp_path / "drive" / "recording") as source:
        counts = {topic.name: topic.count for topic in source.topics}
    with open_recording(tmp_path / "session" / "recording") as recorded:
        assert {topic.name: topic.count for topic in recorded.topics} == counts
    assert read_yaml(tmp_path / "session" / "rig.yaml")["target"] == {"kind": "surroundings"}
    assert (tmp_path / "session" / "result" / "report.html").is_file()
