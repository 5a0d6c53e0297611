"""Scanners followed by several processes."""

import multiprocessing
from collections.abc import Mapping, Sequence

import pytest

from calgraph.config import People, RangeNoise
from calgraph.errors import Rejected
from calgraph.tracking import ScanRun, Tracked, in_runs, parallel_tracking, track_scanners
from walking_scenes import World, along, circling

PEOPLE = People(kind="people")


@pytest.fixture(scope="module")
def scans() -> dict[str, Sequence[ScanRun]]:
    worlds = {
        "one": World((circling(1.5, (3.0, 0.0)),)),
        "two": World((along([(2, -3), (2, 3), (6, 3)]), circling(1.0, (4.0, 0.0)))),
        "nobody": World(()),
    }
    return {name: in_runs(world.scans(12.0, 0)) for name, world in worlds.items()}


@pytest.fixture(autouse=True)
def _worthwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel_tracking, "_WORTHWHILE", 0)


def followed(
    scans: Mapping[str, Sequence[ScanRun]], jobs: int, told: list[float] | None = None
) -> dict[str, Tracked | Rejected]:
    progress = (lambda _done: None) if told is None else told.append
    return track_scanners(scans, PEOPLE, dict.fromkeys(scans, RangeNoise()), jobs=jobs, progress=progress)


def bits(found: Mapping[str, Tracked | Rejected]) -> dict[str, list[bytes] | str]:
    return {
        name: own.reason
        if isinstance(own, Rejected)
        else [
            array.tobytes()
            for track in own.tracks
            for array in (track.times, track.positions, track.velocities, track.covariances, track.hits.points)
        ]
        for name, own in found.items()
    }


def test_the_number_of_processes_does_not_change_a_bit(scans: dict[str, Sequence[ScanRun]]) -> None:
    alone, together = followed(scans, 1), followed(scans, 2)
    assert list(together) == ["one", "two", "nobody"]
    assert bits(together) == bits(alone)


def test_progress_is_told_of_every_scanner(scans: dict[str, Sequence[ScanRun]]) -> None:
    told: list[float] = []
    followed(scans, 2, told)
    assert told == pytest.approx([1 / 3, 2 / 3, 1.0])


def test_no_process_is_left_behind(scans: dict[str, Sequence[ScanRun]]) -> None:
    followed(scans, 2)
    assert multiprocessing.active_children() == []
