"""Whole calibrations on a cluster: the same bits as in one process, whatever is lost on the way."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from calgraph.calibration.dispatch import calibrate
from calgraph.config import load_rig
from calgraph.config.settings import DaskSettings
from calgraph.errors import CalibrationError
from calgraph.io.records import encode_records
from calgraph.network import track_recording
from calgraph.network.options import NetworkOptions
from calgraph.network.track_recording import track_people
from calgraph.parallel.engine import THIS_PROCESS, Engine, Processes
from calgraph.parallel.open_cluster import DaskEngine, open_cluster
from calgraph.recording import NO_CACHE, RecordingCache, open_recordings
from calgraph.result import to_json
from calgraph.rig.options import RigOptions
from calgraph.simulation import NetworkScenario, RigScenario, simulate_network, simulate_rig
from dask_programs import start_scheduler, start_worker, stop

pytestmark = pytest.mark.slow

SMALL_RIG = RigScenario.model_validate(
    {
        "camera": {"width": 480, "height": 360, "rate": 4, "texels_per_mm": 1},
        "laser": {"count": 1, "rate": 10, "resolution": 0.5},
        "spinning": {"count": 0},
        "multibeam": {"count": 1, "rate": 5, "resolution": 0.4},
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
    with open_cluster("local", 3, SETTINGS, dashboard=False) as opened:
        yield opened


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the rig.yaml and the recording of a network; not to be changed."""
    out = tmp_path_factory.mktemp("network") / "network"
    simulate_network(NetworkScenario(layout="lab", duration=15, scanner={"count": 4}), out, seed=2)  # type: ignore[arg-type]
    return out


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same of a rig."""
    out = tmp_path_factory.mktemp("rig") / "rig"
    simulate_rig(SMALL_RIG, out, seed=1)
    return out


def calibrate_all(place: Path, engine: Engine) -> str:
    """All that a calibration states."""
    rig = load_rig(place / "rig.yaml")
    with open_recordings([place / "recording"]) as recording:
        if rig.is_network:
            return to_json(calibrate(rig, recording, NetworkOptions(estimator="averaging", engine=engine)))
        return to_json(calibrate(rig, recording, RigOptions(engine=engine, folds=0)))


@pytest.fixture(autouse=True)
def _divided(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few scans are enough for several calls of the engine."""
    monkeypatch.setattr(track_recording, "_MIN_DIVIDED_SCANS", 1)


Tracked = dict[str, tuple[dict[str, object], list[bytes]]]


def track(place: Path, engine: Engine, cache: RecordingCache = NO_CACHE, at_first: object = None) -> Tracked:
    """The tracks of all scanners; a function is called when the first batch is done."""
    rig = load_rig(place / "rig.yaml")
    calls = [at_first] if callable(at_first) else []
    with open_recordings([place / "recording"]) as recording:
        options = NetworkOptions(engine=engine, cache=cache)
        found, _ = track_people(rig, recording, options, lambda *_: calls.pop()() if calls else None)
    encoded = {name: encode_records(one) for name, one in found.items()}
    return {
        name: (plain, [array.tobytes() for array in arrays.values()]) for name, (plain, arrays) in encoded.items()
    }


@pytest.mark.parametrize("kind", ["network", "robot"])
def test_bits_are_the_same_with_one_process_with_two_and_on_a_cluster(
    kind: str, engine: DaskEngine, request: pytest.FixtureRequest
) -> None:
    place = request.getfixturevalue(kind)
    alone = calibrate_all(place, THIS_PROCESS)
    assert calibrate_all(place, Processes(2)) == alone
    assert calibrate_all(place, engine) == alone


def test_a_worker_that_is_killed_changes_no_bit(engine: DaskEngine, network: Path) -> None:
    killed: list[int] = []

    def kill() -> None:
        killed.append(next(engine.map(os.getpid, [()])))
        os.kill(killed[0], signal.SIGKILL)

    assert track(network, engine, at_first=kill) == track(network, THIS_PROCESS)
    assert killed


def test_a_lost_scheduler_ends_the_run_and_the_next_one_resumes(
    network: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(track_recording, "_MAX_SCANS_IN_MEMORY", 1)  # a batch for each scanner
    scheduler, address = start_scheduler(tmp_path)
    worker = start_worker(address)
    settings = DaskSettings(connect_timeout=30.0, calls_ahead=1)
    try:
        with (
            open_cluster(address, 1, settings) as engine,
            pytest.raises(
                CalibrationError, match=rf"the scheduler at {address} was lost; run the command again: what was"
            ),
        ):
            track(network, engine, RecordingCache(tmp_path / "cache"), scheduler.kill)
    finally:
        stop(worker, scheduler)
    cache = RecordingCache(tmp_path / "cache")
    assert track(network, THIS_PROCESS, cache) == track(network, THIS_PROCESS)
    assert "scanner_1" in cache.reused
    assert "scanner_4" not in cache.reused
