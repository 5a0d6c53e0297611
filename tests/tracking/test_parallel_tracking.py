"""Tracking of scanners in several processes."""

import multiprocessing
from collections.abc import Mapping, Sequence

import pytest

from calgraph.config import People, RangeNoise
from calgraph.engine import Processes
from calgraph.errors import Rejected
from calgraph.tracking import ScannerTracks, ScanRun, parallel_tracking, stack_scans, track_scanners
from walking_scenes import World, walk_along, walk_in_circle

PEOPLE = People(kind="people")


@pytest.fixture(scope="module")
def scans() -> dict[str, Sequence[ScanRun]]:
    worlds = {
        "one": World((walk_in_circle(1.5, (3.0, 0.0)),)),
        "two": World((walk_along([(2, -3), (2, 3), (6, 3)]), walk_in_circle(1.0, (4.0, 0.0)))),
        "empty": World(()),
    }
    return {name: stack_scans(world.simulate_scans(12.0, 0)) for name, world in worlds.items()}


@pytest.fixture(autouse=True)
def _force_parallel(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel_tracking, "_MIN_PARALLEL_BEAMS", 0)


def track_all(
    scans: Mapping[str, Sequence[ScanRun]], jobs: int, report: list[float] | None = None
) -> dict[str, ScannerTracks | Rejected]:
    progress = (lambda _done: None) if report is None else report.append
    return track_scanners(
        scans, PEOPLE, dict.fromkeys(scans, RangeNoise()), engine=Processes(jobs), progress=progress
    )


def serialize(found: Mapping[str, ScannerTracks | Rejected]) -> dict[str, list[bytes] | str]:
    return {
        name: result.reason
        if isinstance(result, Rejected)
        else [
            array.tobytes()
            for track in result.tracks
            for array in (track.times, track.positions, track.velocities, track.covariances, track.hits.points)
        ]
        for name, result in found.items()
    }


def test_the_number_of_processes_does_not_change_a_bit(scans: dict[str, Sequence[ScanRun]]) -> None:
    alone, together = track_all(scans, 1), track_all(scans, 2)
    assert list(together) == ["one", "two", "empty"]
    assert serialize(together) == serialize(alone)


def test_progress_is_reported_for_every_scanner(scans: dict[str, Sequence[ScanRun]]) -> None:
    report: list[float] = []
    track_all(scans, 2, report)
    assert report == pytest.approx([1 / 3, 2 / 3, 1.0])


def test_no_process_survives(scans: dict[str, Sequence[ScanRun]]) -> None:
    track_all(scans, 2)
    assert multiprocessing.active_children() == []
