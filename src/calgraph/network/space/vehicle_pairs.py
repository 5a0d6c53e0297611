"""Vehicles in the joint solution of a network in space: the same one in two sensors, whose outline is unknown.

Each sensor follows some point of a vehicle. With c(t) of one sensor i at the heading (u, n) that it measured, and
the point of another one j at the same time,

    r = T_i c_i(t) + d u + d' n + l v - T_j c_j(t)

with times by the root's clock, where d and d', constant for a pair of tracks, are from one point to the other, and
l is by how much registrations lag behind at the velocity v. They are eliminated. Vehicles that turn thus show
poses, those that drive straight ahead do not.

Source: Lange, Little and Taylor, "Robust statistical modeling using the t distribution", 1989, for the weights.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index, se_n
from calgraph.network.space.observations import BodyTrack, SpaceObservations
from calgraph.network.space.person_paths import eliminate_direction
from calgraph.surfaces.sensor_states import BESIDE_POSE, DRIFT, SensorState, number_free

# Standard deviations of the offset of the points, m: half a width of a van, or half a length of a forklift; and of
# the lag of registrations, s. Clocks of four simulated LiDARs were up to 21 ms off without it.
_OFFSET = np.array([0.8, 0.8, 0.02])
# Least time that two tracks have in common to be compared, s, and by which two may overlap and be of one vehicle.
_MIN_COMMON, _MAX_OVERLAP = 2.0, 0.5
# Time for which errors of registrations are taken as the same, s, their least, and their usual standard
# deviation, m.
_VIEW, _MIN_STDDEV, _USUAL_STDDEV = 1.0, 0.02, 0.05
_FREEDOM, _ROUNDS = 4.0, 4


@dataclass(frozen=True, eq=False)
class VehiclePair:
    """Tracks of one vehicle in two sensors."""

    sensors: tuple[int, int]
    tracks: tuple[BodyTrack, BodyTrack]
    axis: Array
    """(T, 3) unit vectors along the vehicle in the frame of the first sensor."""


@dataclass(frozen=True, eq=False)
class VehicleEquations:
    """Normal equations from all pairs, of P free states."""

    information: Array
    """(P, P)."""
    gradient: Array
    """(P,)."""
    scores: Array
    """(V, P) what each second of a pair contributes to the gradient."""
    time: Array
    """(V,) of these by the root's clock, s."""
    source: Index
    """(V,) number of the pair."""

    def without(self, direction: Array) -> "VehicleEquations":
        """The equations where a further move of the states along a direction (P,) is eliminated as well."""
        information, gradient, scores = (
            eliminate_direction(one, self.information, direction)
            for one in (self.information, self.gradient, self.scores)
        )
        return VehicleEquations(information, gradient, scores, self.time, self.source)


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Places of the first sensor less those of the second, at N common times, with the offset fitted."""

    times: Array
    """(N,) by the root's clock, s."""
    error: Array
    """(N, 2) m."""
    by_offset: Array
    """(N, 2, 3)."""
    offset: Array
    """(3,) along and across the vehicle, m, and lag, s."""
    points: tuple[Array, Array]
    """(N, 3) of both, sensor frames, m, the first with the offset."""
    velocity: Array
    """(N, 2) m/s."""


def find_vehicle_pairs(
    observations: Sequence[SpaceObservations], states: Sequence[SensorState], gate: float
) -> list[VehiclePair]:
    """Tracks of two sensors that are of one vehicle: their median distance is below a gate, m."""
    tracks = [each.vehicles for each in observations]
    near: list[tuple[float, int, int, VehiclePair]] = []
    for i in range(len(tracks)):
        R = observations[i].T_floor_sensor[:3, :3]
        for j in range(i + 1, len(tracks)):
            for a, first in enumerate(tracks[i]):
                assert first.yaws is not None
                axis = np.column_stack([np.cos(first.yaws), np.sin(first.yaws), np.zeros(len(first.yaws))]) @ R
                for b, second in enumerate(tracks[j]):
                    pair = VehiclePair((i, j), (first, second), axis)
                    compared = _compare(pair, states)
                    if compared is not None:
                        distance = float(np.median(np.hypot(*compared.error.T)))
                        if distance < gate:
                            near.append((distance, a, b, pair))
    found: list[VehiclePair] = []
    for _, _, _, pair in sorted(near, key=lambda one: one[:3]):
        if not any(_contradict(pair, other) for other in found):
            found.append(pair)
    return found


def measure_common_time(pairs: Sequence[VehiclePair]) -> float:
    """Time for which two sensors measured the vehicles of pairs, s."""
    spans = [(one.tracks[0].times, one.tracks[1].times) for one in pairs]
    return float(sum(min(a[-1], b[-1]) - max(a[0], b[0]) for a, b in spans))


def _contradict(pair: VehiclePair, other: VehiclePair) -> bool:
    """Whether a track of one sensor would be of two vehicles that another sensor measured at the same time."""
    if pair.sensors != other.sensors:
        return False
    for k in range(2):
        a, b = pair.tracks[1 - k].times, other.tracks[1 - k].times
        if pair.tracks[k] is other.tracks[k] and min(a[-1], b[-1]) - max(a[0], b[0]) > _MAX_OVERLAP:
            return True
    return False


def reduce_vehicles(
    pairs: Sequence[VehiclePair], states: Sequence[SensorState], free: NDArray[np.bool_]
) -> VehicleEquations:
    """The equations of vehicles, of the free states (S, 12)."""
    numbers, size = number_free(free), int(free.sum())
    H, g = np.zeros((size, size)), np.zeros(size)
    scores, times, source = [np.zeros((0, size))], [np.zeros(0)], [np.zeros(0, dtype=np.intp)]
    compared = [(k, pair, one) for k, pair in enumerate(pairs) if (one := _compare(pair, states)) is not None]
    if compared:
        errors = np.concatenate([one.error.ravel() for _, _, one in compared])
        variance = max(1.4826 * float(np.median(np.abs(errors))), _MIN_STDDEV) ** 2
    measured: dict[int, set[int]] = {}
    for pair in pairs:
        for track in pair.tracks:
            measured.setdefault(id(track), set()).update(pair.sensors)
    for k, pair, one in compared:
        N = len(one.times)
        J = np.zeros((N, 2, size))
        for sign, sensor, points in zip((1.0, -1.0), pair.sensors, one.points, strict=True):
            by_state = states[sensor].place(points)[1][:, :2]
            by_state[:, :, -BESIDE_POSE] = one.velocity
            elapsed = one.times + states[sensor].clock_offset - states[sensor].mid_time
            by_state[:, :, DRIFT] = one.velocity * elapsed[:, None]
            J[:, :, numbers[sensor][free[sensor]]] += sign * by_state[:, :, free[sensor]]
        label = np.unique(np.floor(one.times / _VIEW), return_inverse=True)[1].ravel()
        weight = (_FREEDOM + 2) / (_FREEDOM + np.sum(one.error**2, axis=1) / variance)
        weight /= variance * np.bincount(label)[label]
        # All pairs of N sensors have N/2 times the information of their N tracks.
        weight *= 2 / len(measured[id(pair.tracks[0])] | measured[id(pair.tracks[1])])
        D = one.by_offset
        of_offset = np.einsum("n,nri,nrj->ij", weight, D, D) + np.diag(_OFFSET**-2)
        cross = np.einsum("n,nri,nrp->ip", weight, D, J)
        H += np.einsum("n,nrp,nrq->pq", weight, J, J) - cross.T @ np.linalg.solve(of_offset, cross)
        # The fit of the offset has other weights: its remainder is eliminated, too.
        left = np.einsum("n,nri,nr->i", weight, D, one.error) + one.offset / _OFFSET**2
        g += np.einsum("n,nrp,nr->p", weight, J, one.error) - cross.T @ np.linalg.solve(of_offset, left)
        alone = J - np.einsum("nri,ip->nrp", D, np.linalg.solve(of_offset, cross))
        each = np.einsum("n,nrp,nr->np", weight, alone, one.error)
        sums = np.zeros((int(label.max()) + 1, size))
        np.add.at(sums, label, each)
        scores.append(sums)
        times.append(np.bincount(label, one.times) / np.bincount(label))
        source.append(np.full(len(sums), k))
    return VehicleEquations(H, g, np.concatenate(scores), np.concatenate(times), np.concatenate(source))


def _compare(pair: VehiclePair, states: Sequence[SensorState]) -> _Comparison | None:
    """Compares tracks under states; None where they have too little time in common."""
    (i, j), (a, b) = pair.sensors, pair.tracks
    times, dates = states[i].date_stationary(a.times), states[j].date_stationary(b.times)
    inside = (times >= dates[0]) & (times <= dates[-1])
    times = times[inside]
    if len(times) < 3 or np.ptp(times) < _MIN_COMMON:
        return None
    other = np.column_stack([np.interp(times, dates, column) for column in b.centers.T])
    rates = np.gradient(b.centers, dates, axis=0)
    rate = np.column_stack([np.interp(times, dates, column) for column in rates.T])
    at, there = states[i].place(a.centers[inside])[0], states[j].place(other)[0]
    u = (pair.axis[inside] @ states[i].T_root_sensor[:3, :3].T)[:, :2]
    velocity = (rate @ states[j].T_root_sensor[:3, :3].T)[:, :2]
    D = np.stack([u, np.column_stack([-u[:, 1], u[:, 0]]), velocity], axis=2)
    base = (at - there)[:, :2]
    weight = np.ones(len(base))
    # Errors of registrations are the same for a while.
    prior = np.diag(_OFFSET**-2) * _USUAL_STDDEV**2 * len(base) / (1 + np.ptp(times) / _VIEW)
    for _ in range(_ROUNDS):
        H = np.einsum("n,nri,nrj->ij", weight, D, D) + prior
        offset = -np.linalg.solve(H, np.einsum("n,nri,nr->i", weight, D, base))
        error = base + D @ offset
        squared = np.sum(error**2, axis=1)
        weight = 1 / (1 + squared / max(float(np.median(squared)), 1e-6))
    moved = at + np.pad(D[:, :, :2] @ offset[:2], ((0, 0), (0, 1)))
    first = se_n.apply(se_n.inverse(states[i].T_root_sensor), moved)
    return _Comparison(times, error, D, offset, (first, other), velocity)
