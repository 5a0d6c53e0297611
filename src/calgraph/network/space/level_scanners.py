"""2-D scanners in a network in space: level at a usual height, until surfaces show more.

What a level scanner measures of people and walls does not change with its height, and with the square of its tilt
only. Both stay as they are stated, or usual, unless it measures floors and other surfaces that are not upright.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calgraph.config import Lidar2dSpec
from calgraph.geometry import Array, se3, so3
from calgraph.network.space.observations import BodyTrack, SpaceObservations, StaticPoints
from calgraph.network.tracking.track import ScannerTracks, Track
from calgraph.surfaces.sensor_states import SensorState

# Height of a scanner that states none, m, and its standard deviation: from shins to heads.
_USUAL_HEIGHT, _HEIGHT_STDDEV = 0.9, 0.5
# Standard deviation of a stated height, m: of a tape measure, and of the floor about the scanner. LiDARs have to
# measure that floor within this distance, m, at this many points.
_STATED_STDDEV, _NEAR, _MIN_POINTS = 0.05, 2.5, 10
# Slope of the floor, to which LiDARs are levelled, rad (0.3°): scanners are levelled to gravity.
_SLOPE = 0.005
# First guesses of a body's errors along and across the line of sight, m: legs that step, arms, and beams between.
_RADIAL, _TANGENTIAL = 0.04, 0.03


def observe_scanner(tracked: ScannerTracks, spec: Lidar2dSpec, inverted: bool) -> SpaceObservations:
    """What a 2-D scanner measured, as of a level sensor.

    Args:
        tracked: in its own frame, and by its clock.
        spec: of the scanner, with what is stated of its height and tilt.
        inverted: whether it is mounted upside-down.
    """
    known = np.isfinite(tracked.background).all(axis=1)
    points = np.pad(tracked.background[known], ((0, 0), (0, 1)))
    tilt = np.radians([spec.roll or 0.0, spec.pitch or 0.0])
    R = so3.exp(np.array([0.0, tilt[1], 0.0])) @ so3.exp(np.array([tilt[0], 0.0, 0.0]))
    height = _USUAL_HEIGHT if spec.height is None else spec.height
    stddev = _HEIGHT_STDDEV if spec.height is None else _STATED_STDDEV
    count = len(points)
    none = np.zeros(count, dtype=np.bool_)
    times = [track.times for track in tracked.tracks]
    measured = np.array([[min(t[0] for t in times), max(t[-1] for t in times)]])
    return SpaceObservations(
        se3.pose(R @ np.diag([1.0, -1.0, -1.0]) if inverted else R, np.array([0.0, 0.0, height])),
        np.diag([*[np.hypot(np.radians(spec.uncertainty.tilt), _SLOPE)] * 2, stddev]) ** 2,
        StaticPoints(points, np.full(count, tracked.sigma), np.ones(count, dtype=np.intp)),
        none,
        tuple(_measure_bodies(track) for track in tracked.tracks),
        measured if tracked.coverage is None else tracked.coverage,
        flat=True,
    )


def stand_on_floor(
    state: SensorState, observed: SpaceObservations, lidars: Sequence[tuple[SensorState, SpaceObservations]]
) -> tuple[SensorState, SpaceObservations]:
    """The start of a scanner over the floor at its place, as LiDARs measure it; its height is unknown without."""
    T = state.T_root_sensor.copy()
    floor = np.concatenate([at.place(one.static.points[one.floor_points])[0] for at, one in lidars])
    near = floor[np.hypot(*(floor - T[:3, 3])[:, :2].T) < _NEAR]
    if len(near) < _MIN_POINTS:
        covariance = observed.floor_covariance.copy()
        covariance[2, 2] = _HEIGHT_STDDEV**2
        return state, replace(observed, floor_covariance=covariance)
    T[2, 3] += np.median(near[:, 2])
    return replace(state, T_root_sensor=T), observed


def _measure_bodies(track: Track) -> BodyTrack:
    """The middle of the silhouette, at the mean range, of the beams on a body in each scan."""
    hits = track.hits
    first = np.searchsorted(hits.time_index, np.arange(len(track.times)))
    counts = np.diff(first, append=len(hits.points))
    heading = np.arctan2(track.positions[:, 1], track.positions[:, 0])
    bearing = np.arctan2(hits.points[:, 1], hits.points[:, 0]) - heading[hits.time_index]
    bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
    middle = heading + (np.minimum.reduceat(bearing, first) + np.maximum.reduceat(bearing, first)) / 2
    ranges: Array = np.add.reduceat(np.hypot(*hits.points.T), first) / counts
    centers = np.column_stack([ranges * np.cos(middle), ranges * np.sin(middle), np.zeros(len(ranges))])
    T = len(ranges)
    return BodyTrack(track.times, centers, np.full(T, _RADIAL), np.full(T, _TANGENTIAL), counts)
