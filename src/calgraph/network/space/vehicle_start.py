"""Pairs of sensors from vehicles that both measured, where people do not connect them.

The points that two sensors follow of a vehicle are up to a vehicle apart, which trajectories of people are not. A
pose is proposed from each two tracks at the same time, and all others vote for it; walls then align it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from calgraph.errors import Rejected
from calgraph.geometry import Array, se2, se_n
from calgraph.network.pairs.hypothesis_evidence import PoseHypothesis
from calgraph.network.pairs.icp import StaticBackground, align_backgrounds
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate
from calgraph.network.pairs.synchronized_tracks import to_ticks
from calgraph.network.scanner_pairs import CorrectedPairs
from calgraph.network.space.observations import BodyTrack, SpaceObservations
from calgraph.network.space.vehicle_pairs import find_vehicle_pairs, measure_common_time, reduce_vehicles
from calgraph.network.tracking.track import ScannerTracks
from calgraph.surfaces.sensor_states import BESIDE_POSE, SensorState, move_states

# Least common time of tracks that propose a pose, s, and least way of both, m; least time of all that agree, s.
_MIN_COMMON, _MIN_WAY, _MIN_AGREEING = 3.0, 2.0, 8.0
# Median distance of tracks of one vehicle, m, under proposed poses, and after their refinement.
_GATES = (0.5, 0.4, 0.3, 0.2)
# Standard deviations of refined poses, m and rad, and of clocks before, s.
_STDDEV, _CLOCK_STDDEV = np.array([0.2, 0.2, 0.03]), 0.1
# Largest standard deviation of a place by vehicles, m: half of the distance, 0.3 m, up to which points of walls
# match. In 17 halls of two LiDARs it is up to 0.12, with start poses up to 0.4 m off; one with 0.35 was 1.4 m off,
# and walls held it there.
_MAX_STDDEV = 0.15
# Standard deviation of distances of registered tracks, m: assumed to be that of tracks of people, as walls and the
# joint solution correct these poses.
_MODEL_ERROR = 0.08
# Share of the best one's time from which another pose is as likely: assumed; in six halls no pair is wrong.
_AMBIGUOUS = 0.7
# Distances up to which two poses are the same, m and rad.
_SAME = np.array([1.0, 1.0, 0.15])


def pair_by_vehicles(
    observations: Mapping[str, SpaceObservations], corrected: CorrectedPairs, connected: frozenset[str]
) -> dict[tuple[str, str], ScannerPairEstimate]:
    """Poses of the pairs of sensors that people do not connect, in their levelled planes.

    Args:
        observations: of sensors that measured vehicles, by their clocks.
        corrected: pairs by people, and what is known of clocks.
        connected: sensors that people connect to the root.
    """
    found = {}
    by_root = {
        name: replace(one, vehicles=_correct_clock(one.vehicles, corrected.clock_offset.get(name, 0.0)))
        for name, one in observations.items()
    }
    for ends in combinations(observations, 2):
        known = corrected.pairs.get(ends)
        if isinstance(known, ScannerPairEstimate) or connected.issuperset(ends):
            continue
        one = _find_pose([by_root[name] for name in ends], [corrected.tracked[name] for name in ends])
        if one is not None:
            found[ends] = ScannerPairEstimate(*ends, (one,))
    return found


def _correct_clock(tracks: Sequence[BodyTrack], offset: float) -> tuple[BodyTrack, ...]:
    return tuple(replace(one, times=one.times - offset) for one in tracks)


def _find_pose(observed: Sequence[SpaceObservations], tracked: Sequence[ScannerTracks]) -> PoseHypothesis | None:
    """The pose under which most tracks of vehicles agree, by far; None without one."""
    refined: list[tuple[float, Array, float]] = []
    for T in _propose(observed):
        if any(np.all(np.abs(se2.difference(T, one)) < _SAME) for _, one, _ in refined):
            continue
        pose = _refine(observed, T)
        if pose is not None:
            refined.append(pose)
    refined.sort(key=lambda one: -one[0])
    if not refined:
        return None
    agreeing, T, clock = refined[0]
    others = [one[0] for one in refined if np.any(np.abs(se2.difference(one[1], T)) > _SAME)]
    if agreeing < _MIN_AGREEING or max(others, default=0.0) > _AMBIGUOUS * agreeing:
        return None
    a, b = (StaticBackground(one.background) for one in tracked)
    covariance, by_walls = np.diag(_STDDEV**2), False
    aligned = align_backgrounds(T, covariance, a, b, max(one.sigma for one in tracked))
    information = np.asarray(np.linalg.inv(covariance))
    if not isinstance(aligned, Rejected):
        T, information = aligned.fuse(T, information)
        by_walls = True
    return PoseHypothesis(
        T, information, to_ticks(agreeing), 0.0, 1.0, 0.0, _MODEL_ERROR, by_walls, clock, _CLOCK_STDDEV / 3, 1.0
    )


def _propose(observed: Sequence[SpaceObservations]) -> list[Array]:
    """Poses (3, 3) under which two simultaneous tracks coincide."""
    levelled = [
        [(one, se_n.apply(each.T_floor_sensor, one.centers)[:, :2]) for one in each.vehicles] for each in observed
    ]
    proposed = []
    for first, at in levelled[0]:
        for second, there in levelled[1]:
            inside = (first.times >= second.times[0]) & (first.times <= second.times[-1])
            if inside.sum() < 5 or np.ptp(first.times[inside]) < _MIN_COMMON:
                continue
            p = at[inside] @ [1, 1j]
            q = np.array([np.interp(first.times[inside], second.times, column) for column in there.T]).T @ [1, 1j]
            if min(np.ptp(p.real) + np.ptp(p.imag), np.ptp(q.real) + np.ptp(q.imag)) < _MIN_WAY:
                continue
            turn = np.vdot(q - q.mean(), p - p.mean())
            shift = p.mean() - turn / abs(turn) * q.mean()
            proposed.append(se2.pose(float(np.angle(turn)), np.array([shift.real, shift.imag])))
    return proposed


def _refine(observed: Sequence[SpaceObservations], T: Array) -> tuple[float, Array, float] | None:
    """Time for which tracks agree, s, the refined pose (3, 3), and the clock of the second, s.

    None where no tracks agree, or where they leave the place open: vehicles that drove straight ahead.
    """
    a, b = observed
    states = [SensorState(a.T_floor_sensor), SensorState(np.asarray(se2.to_se3(T) @ b.T_floor_sensor))]
    free = np.zeros((2, 6 + BESIDE_POSE), dtype=np.bool_)
    free[1, [0, 1, 5, 6]] = True
    prior = np.diag(np.array([1.0, 1.0, 0.1, _CLOCK_STDDEV]) ** -2.0)
    clock = 0.0
    for gate in _GATES:
        pairs = find_vehicle_pairs(observed, states, gate)
        if not pairs:
            return None
        driven = reduce_vehicles(pairs, states, free)
        left = np.array([0.0, 0.0, 0.0, states[1].clock_offset / _CLOCK_STDDEV**2])
        information = driven.information + prior
        step = -np.linalg.solve(information, driven.gradient + left)
        states = move_states(states, free, step)
        clock = states[1].clock_offset
    if np.diag(np.linalg.inv(information))[:2].max() > _MAX_STDDEV**2:
        return None
    T_plane = states[1].T_root_sensor @ se_n.inverse(b.T_floor_sensor)
    pose = se2.pose(float(np.arctan2(T_plane[1, 0], T_plane[0, 0])), T_plane[:2, 3])
    return measure_common_time(pairs), pose, clock
