"""Tracks of people in a network over time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array
from calgraph.result import Calibration, FloorView
from calgraph.viewer.colored_clouds import floor_to_sensor_frame
from calgraph.viewer.view_state import ViewState

# Duration of the drawn part of a track before the selected moment, s.
_TRAIL_DURATION = 4.0
# Largest time since the last position of a person who is drawn, s.
_MAX_PRESENT_AGE = 0.7


@dataclass(frozen=True, eq=False)
class Trail:
    """Tracks of people in one scanner at one moment."""

    segments: NDArray[np.float32]
    """(K, 2, 3) segments of their tracks, in the scanner's frame, m."""
    people: NDArray[np.float32]
    """(P, 3) their positions; none if all tracks are shown."""


def compute_trails(calibration: Calibration, state: ViewState) -> dict[str, Trail]:
    """By scanner, the tracks at the selected moment."""
    return {
        view.sensor: _build_trail(calibration, view, state.moment) for view in calibration.pictures.floor_views
    }


def recording_duration(calibration: Calibration) -> float:
    """Time of the last position of all tracks, s from the start of the recording; 0 without times."""
    times = [times for view in calibration.pictures.floor_views for times in view.times]
    return float(np.nanmax(np.concatenate([np.zeros(1), *times])))


def _build_trail(calibration: Calibration, view: FloorView, moment: float | None) -> Trail:
    segments, people = [np.empty((0, 2, 2))], [np.empty((0, 2))]
    for k, walk in enumerate(view.tracks):
        if moment is None:
            segments.append(_segments_between(walk))
            continue
        age = moment - view.times[k]
        segments.append(_segments_between(walk[(age >= 0) & (age < _TRAIL_DURATION)]))
        passed = np.flatnonzero(age >= 0)
        if len(passed) and age[passed[-1]] < _MAX_PRESENT_AGE:
            people.append(walk[passed[-1:]])
    points = floor_to_sensor_frame(calibration, view.sensor, np.concatenate(segments).reshape(-1, 2))
    return Trail(points.reshape(-1, 2, 3), floor_to_sensor_frame(calibration, view.sensor, np.concatenate(people)))


def _segments_between(walk: Array) -> Array:
    """(K, 2, 2) segments between successive positions (K + 1, 2)."""
    return np.stack([walk[:-1], walk[1:]], axis=1)
