"""Rigs on a cluster, whose workers read parts of the recording themselves."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calgraph.config import Rig, load_rig
from calgraph.config.settings import DaskSettings
from calgraph.errors import CalibrationError
from calgraph.parallel.engine import Processes
from calgraph.parallel.open_cluster import DaskEngine, open_cluster
from calgraph.parallel.progress import Progress, no_progress
from calgraph.recording import RecordingCache, open_recordings
from calgraph.rig.capture_collection import collect_captures
from calgraph.rig.captures import hold_messages, sensor_detection, timeline_reading
from calgraph.rig.captures.clock_alignment import correct_by_arrival
from calgraph.rig.options import RigOptions
from calgraph.simulation import RigScenario, simulate_rig
from dask_programs import start_scheduler, start_worker, stop

pytestmark = pytest.mark.slow

SCENARIO = RigScenario.model_validate(
    {
        "camera": {"width": 320, "height": 240, "rate": 4, "texels_per_mm": 0.5},
        "laser": {"count": 1, "rate": 10, "resolution": 0.5},
        "spinning": {"count": 0},
        "multibeam": {"count": 1, "rate": 5, "rings": 16, "resolution": 0.5},
        "bearings": [-30, 0, 30],
        "radii": [1.8],
        "samples": 3,
        "background": 2.5,
        "hold_time": 0.8,
        "move_time": 0.4,
        "clutter": 2,
    }
)
SETTINGS = DaskSettings(connect_timeout=30.0)


@pytest.fixture(scope="module")
def engine() -> Iterator[DaskEngine]:
    with open_cluster("local", 2, SETTINGS, dashboard=False) as opened:
        yield opened


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the rig.yaml and the recording of a rig; not to be changed."""
    out = tmp_path_factory.mktemp("rig") / "rig"
    simulate_rig(SCENARIO, out, seed=1)
    return out


def load(place: Path, *, trigger: bool = True, **camera: Any) -> Rig:
    """The rig with other keys of its camera; without a trigger, holds are found by stillness."""
    plain = load_rig(place / "rig.yaml").to_plain()
    if not trigger:
        plain["capture"]["trigger"] = None
    plain["sensors"]["camera"] |= camera
    return Rig.model_validate(plain)


def collect(
    place: Path, rig: Rig, options: RigOptions, progress: Progress = no_progress, *, url: bool = False
) -> str:
    """All captures with their detections, to the last bit."""
    path = place / "recording"
    with (
        open_recordings([path.as_uri() if url else path]) as recording,
        # Texts of arrays take minutes.
        np.printoptions(override_repr=lambda array: f"{array.dtype} {array.shape} {array.tobytes().hex()}"),
    ):
        rig, corrected, clocks, _ = correct_by_arrival(rig, recording, options.cache)
        return repr(collect_captures(rig, corrected, options, np.random.default_rng(0), progress, clocks))


@pytest.fixture(scope="module")
def expected(robot: Path) -> str:
    """What one process collects for the rig as it is."""
    return collect(robot, load(robot), RigOptions())


@pytest.fixture
def nothing_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    """This process gathers no messages for calls."""

    def refuse(*_arguments: object) -> None:
        raise AssertionError("messages are sent")

    monkeypatch.setattr(hold_messages, "gather_messages", refuse)
    monkeypatch.setattr(timeline_reading, "_measure_sent", refuse)


@pytest.mark.parametrize(
    "camera",
    [{}, {"clock_offset": 0.01}, {"camera_info": None, "intrinsics": "estimate"}],
    ids=["as it is", "clock offset", "intrinsics"],
)
def test_bits_are_the_same_with_one_process_with_four_and_where_workers_read_the_messages(
    engine: DaskEngine, robot: Path, camera: dict[str, Any], request: pytest.FixtureRequest
) -> None:
    rig = load(robot, **camera)
    alone = collect(robot, rig, RigOptions()) if camera else request.getfixturevalue("expected")
    assert "BoardCorners(" in alone
    assert collect(robot, rig, RigOptions(engine=Processes(4))) == alone
    request.getfixturevalue("nothing_sent")
    assert collect(robot, rig, RigOptions(engine=engine)) == alone


def test_activity_has_the_same_bits_where_workers_read_the_recording_at_a_url(
    engine: DaskEngine, robot: Path, request: pytest.FixtureRequest
) -> None:
    rig = load(robot, trigger=False)
    alone = collect(robot, rig, RigOptions(engine=Processes(4)))
    request.getfixturevalue("nothing_sent")
    assert collect(robot, rig, RigOptions(engine=engine), url=True) == alone


def lose_scheduler(robot: Path, rig: Rig, folder: Path, cache: RecordingCache) -> str:
    """The error of a run whose scheduler is lost after the first part was searched; empty if it ended before."""
    scheduler, address = start_scheduler(folder)
    worker = start_worker(address)

    def kill(step: str, _share: float) -> None:
        if step == "detecting":
            scheduler.kill()
            scheduler.wait()

    try:
        # A client waits as long for a scheduler that it has lost.
        with open_cluster(address, 1, DaskSettings(connect_timeout=10.0, calls_ahead=1)) as engine:
            collect(robot, rig, RigOptions(engine=engine, cache=cache), kill)
    except CalibrationError as error:
        return str(error)
    finally:
        stop(worker, scheduler)
    return ""


def test_a_lost_scheduler_ends_the_run_and_the_next_one_resumes(
    robot: Path, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig, error = load(robot), ""
    # A run may end before its scheduler does.
    for attempt in range(5):
        cache = RecordingCache(tmp_path / f"cache_{attempt}")
        error = lose_scheduler(robot, rig, tmp_path, cache)
        if "was lost" in error:
            break
    assert re.search(r"the scheduler at tcp:\S+ was lost; run the command again", error)
    searched: list[tuple[int, str]] = []
    search = sensor_detection.detect_in_hold

    def count(detectors: Any, capture: int, name: str, *rest: Any) -> Any:
        searched.append((capture, name))
        return search(detectors, capture, name, *rest)

    monkeypatch.setattr(sensor_detection, "detect_in_hold", count)
    assert collect(robot, rig, RigOptions(cache=cache)) == expected
    # Of four parts the first one was searched, three of nine holds, and another if it ended with it.
    first = min(capture for capture, _ in searched)
    assert first in (3, 6)
    assert sorted(searched) == [(capture, name) for capture in range(first, 9) for name in sorted(rig.sensors)]
