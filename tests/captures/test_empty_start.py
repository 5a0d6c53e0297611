"""The time before anything enters a scanner's view: found, and not taken for a board that rests."""

from collections.abc import Callable

import numpy as np
import pytest

from calgraph.captures import EmptyStart, find_empty_start
from calgraph.config.settings import EmptyStartSettings
from calgraph.geometry import Array
from calgraph.recording.in_memory import MessageRecording
from calgraph.sensors import LaserScan, PointCloud

SETTINGS = EmptyStartSettings()
ANGLES = np.radians(np.arange(-90.0, 90.0, 0.5))
WALL, PERSON = 4.0, 2.0
IN_VIEW, ELSEWHERE = (np.abs(ANGLES - angle) < np.radians(4) for angle in (0.3, -0.4))


def view(*bodies: Array) -> Array:
    """Ranges to bodies in front of a wall."""
    return np.where(np.any(bodies, axis=0), PERSON, WALL) if bodies else np.full(len(ANGLES), WALL)


def record(view_at: Callable[[float], Array], rate: float = 10.0) -> MessageRecording:
    """Scans whose ranges are a function of time, with noise of 2 cm."""
    rng = np.random.default_rng(3)
    return MessageRecording(
        {
            "/scan": [
                LaserScan(float(t), "", ANGLES, view_at(float(t)) + 0.02 * rng.standard_normal(len(ANGLES)))
                for t in np.arange(0.0, 20.0, 1 / rate)
            ]
        }
    )


def find(recording: MessageRecording) -> EmptyStart | None:
    return find_empty_start(recording, ["/scan"], SETTINGS)


def test_it_ends_before_a_person_enters() -> None:
    found = find(record(lambda t: view(IN_VIEW) if t > 4.95 else view()))
    assert found is not None
    assert found.topic == "/scan"
    assert [found.entry, found.end] == pytest.approx([5.0, 4.7])


def test_a_board_that_rests_in_view_at_the_start_is_not_empty() -> None:
    assert find(record(lambda t: view(ELSEWHERE) if t > 4.95 else view(IN_VIEW))) is None


def test_a_start_that_is_too_short_is_none() -> None:
    assert find(record(lambda t: view(IN_VIEW) if t > 1.55 else view())) is None


def test_a_recording_without_anybody_has_none() -> None:
    assert find(record(lambda _: view())) is None


def test_a_single_scan_with_something_else_is_no_entry() -> None:
    assert find(record(lambda t: view(IN_VIEW) if 4.95 < t < 5.05 else view())) is None


def test_a_scanner_slower_than_the_reference_is_searched() -> None:
    found = find(record(lambda t: view(IN_VIEW) if t > 7.0 else view(), rate=1 / 1.5))
    assert found is not None
    assert found.entry == pytest.approx(7.5)


def test_clouds_are_searched_as_scans_are() -> None:
    azimuth, elevation = (grid.ravel() for grid in np.meshgrid(ANGLES, np.radians(np.arange(-10.0, 11.0, 2.0))))
    rays = np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    person = (np.abs(azimuth - 0.3) < 0.07) & (np.abs(elevation) < 0.1)
    clouds = [
        PointCloud(float(t), "", rays * np.where(person & (t > 4.95), PERSON, WALL)[:, None])
        for t in np.arange(0.0, 20.0, 0.1)
    ]
    found = find_empty_start(MessageRecording({"/points": clouds}), ["/points"], SETTINGS)
    assert found is not None
    assert found.entry == pytest.approx(5.0)
