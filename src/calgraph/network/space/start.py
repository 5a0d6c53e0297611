"""Start poses and clocks of a network in space: tracks in levelled planes are those of a planar one.

2-D scanners are level at a usual height, until surfaces show more: what a level scanner measures of people and
walls does not change with its height, and with the square of its tilt only. Both stay as they are stated, or
usual, unless it measures floors and other surfaces that are not upright.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.config import Lidar2dSpec, Rig
from calgraph.geometry import Array, se2, se3, so3
from calgraph.network.graph.network_initialization import NetworkInitialization
from calgraph.network.options import NetworkOptions
from calgraph.network.scanner_pairs import CorrectedPairs, average_pairs, pair_scanners
from calgraph.network.space.body_tracks import to_scanner_tracks
from calgraph.network.space.observations import BodyTrack, SpaceObservations, StaticPoints
from calgraph.network.space.vehicle_start import pair_by_vehicles
from calgraph.network.space.vehicles import leave_out_vehicles
from calgraph.network.tracking.track import ScannerTracks, Track, correct_tracks
from calgraph.parallel.progress import Progress
from calgraph.result.finding import Finding
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
    return BodyTrack(
        track.times, centers, np.full(T, _RADIAL), np.full(T, _TANGENTIAL), np.zeros(T, dtype=np.intp)
    )


@dataclass(frozen=True, eq=False)
class SpaceStart:
    """Start values of the joint solution, and what they come from."""

    observed: Mapping[str, SpaceObservations]
    """What each sensor measured, 2-D scanners included."""
    corrected: CorrectedPairs
    """Tracks in levelled planes, and their pairs."""
    initialization: NetworkInitialization
    """Poses in the levelled plane of the root."""
    states: Mapping[str, SensorState]
    """By connected sensor, the root first, in the levelled frame of the root."""


def start_in_space(
    rig: Rig,
    observations: Mapping[str, SpaceObservations],
    scanners: Mapping[str, ScannerTracks],
    options: NetworkOptions,
    rng: np.random.Generator,
    progress: Progress,
) -> SpaceStart:
    """Start values of the sensors that people, or vehicles, connect to the root.

    A levelled sensor has three unknowns beside its clock, those of a planar scanner: pairs are registered and
    averaged as such.

    Args:
        rig: the network.
        observations: of 3-D LiDARs.
        scanners: tracks of 2-D scanners.
        options: of averaging.
        rng: of samples.
        progress: called with the step and the fraction done.
    """
    settings = rig.settings.tracking
    tracked = {name: to_scanner_tracks(one, settings) for name, one in observations.items()}
    # A scan plane that is tilted leaves bodies, and ends on floors: people whom it does not detect before its
    # background contradict nothing, and walls at several heights differ.
    bare = {name: replace(one, background=np.zeros((0, 2))) for name, one in scanners.items()}
    corrected = pair_scanners(rig, {**tracked, **bare}, options, rng, progress)
    on_foot = {name: replace(one, vehicles=()) for name, one in observations.items()}
    start = _place_sensors(rig, on_foot, scanners, corrected, options, rng)
    driven = {name: one for name, one in observations.items() if one.vehicles}
    if len(start.states) == len(tracked) + len(scanners) or len(driven) < 2:
        return start
    # Parts of vehicles that are tracked as people contradict poses, and are none.
    apart = {name: leave_out_vehicles(one) for name, one in observations.items()}
    no_people = {name: replace(corrected.tracked[name], tracks=()) for name in driven}
    by_vehicles = pair_by_vehicles(driven, corrected, frozenset(start.states))
    without = replace(
        corrected, tracked={**corrected.tracked, **no_people}, pairs={**corrected.pairs, **by_vehicles}
    )
    other = _place_sensors(rig, apart, scanners, without, options, rng)
    if len(other.states) <= len(start.states):
        return start
    people = {name: corrected.tracked[name] for name in driven}
    added = tuple(name for name in other.states if name not in start.states)
    # In one of 13 halls of four LiDARs, the root was 0.37 m off at 5 to 7 standard deviations, and walls agreed.
    remark = Finding(
        f"vehicles connect {', '.join(added)} to the others, along whose ways poses may be wrong: let people walk "
        "between them",
        added,
    )
    complete = replace(
        other.corrected,
        tracked={**other.corrected.tracked, **people},
        findings=(*other.corrected.findings, remark),
    )
    return replace(other, corrected=complete)


def _place_sensors(
    rig: Rig,
    observations: Mapping[str, SpaceObservations],
    scanners: Mapping[str, ScannerTracks],
    corrected: CorrectedPairs,
    options: NetworkOptions,
    rng: np.random.Generator,
) -> SpaceStart:
    """Start values from averages of pairs."""
    start = average_pairs(rig, corrected, options.select_method(rig.settings.published), rng)
    clocks = np.nan_to_num(start.average_clocks()[:, 0])
    observed, complete = dict(observations), dict(corrected.tracked)
    for name, one in scanners.items():
        spec = rig.sensors[name]
        assert isinstance(spec, Lidar2dSpec)
        inverted = name in corrected.inverted
        observed[name] = observe_scanner(one, spec, inverted)
        complete[name] = replace(complete[name], background=correct_tracks(one, inverted=inverted).background)
    states = {
        name: SensorState(
            np.asarray(se2.to_se3(start.solution.T_root_node[node]) @ observed[name].T_floor_sensor),
            corrected.clock_offset.get(name, 0.0) + float(clocks[node]),
        )
        for node, name in enumerate(start.names)
        if name in observed
    }
    lidars = [(states[name], one) for name, one in observations.items() if name in states]
    for name in scanners:
        if name in states:
            states[name], observed[name] = stand_on_floor(states[name], observed[name], lidars)
    return SpaceStart(observed, replace(corrected, tracked=complete), start, states)
