"""Who walked through a network, and when."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array
from calgraph.result import Calibration, FloorView
from calgraph.viewer.colored_clouds import on_floor
from calgraph.viewer.view_state import Choice

# How long a walk is still drawn after somebody was there, s.
_TRAIL = 4.0
# Somebody is shown where they were seen last, if that was so shortly before, s.
_PRESENT = 0.7


@dataclass(frozen=True, eq=False)
class Trail:
    """What one scanner saw of people."""

    segments: NDArray[np.float32]
    """(K, 2, 3) along which they walked, in the scanner's frame, m."""
    people: NDArray[np.float32]
    """(P, 3) where they are; none if all walks are shown at once."""


def trails(calibration: Calibration, choice: Choice) -> dict[str, Trail]:
    """By scanner, the walks of the moment chosen."""
    return {view.sensor: _trail(calibration, view, choice.moment) for view in calibration.pictures.floor_views}


def duration(calibration: Calibration) -> float:
    """When the last of those was seen who walked, s from the start of the recording; 0 if times are not known."""
    times = [times for view in calibration.pictures.floor_views for times in view.times]
    return float(np.nanmax(np.concatenate([np.zeros(1), *times])))


def _trail(calibration: Calibration, view: FloorView, moment: float | None) -> Trail:
    segments, people = [np.empty((0, 2, 2))], [np.empty((0, 2))]
    for k, walk in enumerate(view.tracks):
        if moment is None:
            segments.append(_steps(walk))
            continue
        age = moment - view.times[k]
        segments.append(_steps(walk[(age >= 0) & (age < _TRAIL)]))
        passed = np.flatnonzero(age >= 0)
        if len(passed) and age[passed[-1]] < _PRESENT:
            people.append(walk[passed[-1:]])
    laid = on_floor(calibration, view.sensor, np.concatenate(segments).reshape(-1, 2))
    return Trail(laid.reshape(-1, 2, 3), on_floor(calibration, view.sensor, np.concatenate(people)))


def _steps(walk: Array) -> Array:
    """(K, 2, 2) from each position (K + 1, 2) to the next."""
    return np.stack([walk[:-1], walk[1:]], axis=1)
