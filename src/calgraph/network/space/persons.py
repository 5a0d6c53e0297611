"""Which tracks of several sensors are of one person: by their places under the present poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array, Index, se_n, select_rows
from calgraph.network.space.observations import SpaceObservations
from calgraph.surfaces.sensor_states import BESIDE_POSE, SensorState

UPPER_SLICES = 3
"""Of upper bodies, which 3-D LiDARs measure."""
LEVELLING = slice(2, 5)
"""Height, roll and pitch among the numbers of a state."""
# Distance from the front of a body to its axis, m, by which tracks are moved outward before they are compared.
FRONT = 0.13
# Least time that tracks of two sensors have in common to be compared, s: a step of a walk.
_MIN_COMMON = 0.5
# Time by which tracks of one sensor may overlap and be of one person, s: a sweep.
_MAX_OVERLAP = 0.15
# Time within which a second sensor has to measure a person for a sample to count, s: some sweeps.
_SUPPORT = 0.25
# A person whom no sensor measures for longer is a new one, s; so is one who stays for longer than the second time,
# which bounds the size of the equations.
_MAX_GAP, _MAX_STAY = 1.0, 60.0


@dataclass(frozen=True, eq=False)
class BodySamples:
    """Measured places of bodies, by sensor, track and time."""

    sensor: Index
    """(N,)."""
    track: Index
    """(N,) numbered over all sensors."""
    time: Array
    """(N,) by the sensor's clock, s."""
    center: Array
    """(N, 3) sensor frame, m; see :class:`BodyTrack`."""
    stddev: Array
    """(N, 2) radial and tangential, first guesses, m."""
    band: Index
    """(N,) which slice of bodies: the first are those of :data:`UPPER_SLICES`; each 2-D scanner has its own."""


def gather_samples(observations: Sequence[SpaceObservations]) -> BodySamples:
    """The samples of the tracks of all sensors."""
    tracks = [(k, track) for k, one in enumerate(observations) for track in one.tracks]
    counts = [len(track.times) for _, track in tracks]
    if not sum(counts):
        none = np.zeros(0, dtype=np.intp)
        return BodySamples(none, none, np.zeros(0), np.zeros((0, 3)), np.zeros((0, 2)), none)
    sensor = np.repeat([k for k, _ in tracks], counts)
    flat: Array = np.array([one.flat for one in observations])
    return BodySamples(
        sensor,
        np.repeat(np.arange(len(tracks)), counts),
        np.concatenate([track.times for _, track in tracks]),
        np.concatenate([track.centers for _, track in tracks]),
        np.concatenate([np.column_stack([t.radial_stddev, t.tangential_stddev]) for _, t in tracks]),
        np.where(flat, UPPER_SLICES - 1 + np.cumsum(flat), 0)[sensor]
        + np.concatenate([t.slices for _, t in tracks]),
    )


def date_samples(samples: BodySamples, states: Sequence[SensorState]) -> Array:
    """(N,) times of samples by the root's clock, s."""
    times = np.zeros(len(samples.time))
    for k, state in enumerate(states):
        of = samples.sensor == k
        times[of] = state.date_stationary(samples.time[of])
    return times


def place_samples(samples: BodySamples, states: Sequence[SensorState]) -> Array:
    """(N, 3) places of samples in the world, m."""
    places = np.zeros_like(samples.center)
    for k, state in enumerate(states):
        of = np.flatnonzero(samples.sensor == k)
        places[of] = state.place(samples.center[of])[0]
    return places


def point_outward(samples: BodySamples, states: Sequence[SensorState], places: Array) -> Array:
    """(N, 2) horizontal unit vectors from the sensors of samples to places (N, 2), m."""
    origins = np.array([state.T_root_sensor[:2, 3] for state in states])
    away = places - origins[samples.sensor]
    return np.asarray(away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6))


def derive_places(samples: BodySamples, states: Sequence[SensorState], places: Array) -> Array:
    """(N, 2, 12) derivatives, by the state of the sensor, of samples that are at places (N, 3), m.

    Places in the plane of a level scanner change with the square of its tilt only, which is left out.
    """
    derivatives = np.zeros((len(places), 2, 6 + BESIDE_POSE))
    for k, state in enumerate(states):
        of = np.flatnonzero(samples.sensor == k)
        points = se_n.apply(se_n.inverse(state.T_root_sensor), places[of])
        derivatives[of] = state.place(points)[1][:, :2]
    derivatives[samples.band >= UPPER_SLICES, :, LEVELLING] = 0.0
    return derivatives


def find_persons(samples: BodySamples, states: Sequence[SensorState], gate: float) -> list[BodySamples]:
    """The samples of each person whom two sensors and more measured, in order of time.

    Args:
        samples: of all sensors.
        states: of these.
        gate: median distance of two tracks of one person at most, m.
    """
    if not len(samples.time):
        return []
    times = date_samples(samples, states)
    at = place_samples(samples, states)[:, :2]
    person = _join_tracks(samples, times, at + FRONT * point_outward(samples, states, at), gate)
    found = []
    order = np.lexsort((times, person))
    for of_one in np.split(order, np.flatnonzero(np.diff(person[order])) + 1):
        rows = of_one[_has_support(samples.sensor[of_one], times[of_one])]
        if not len(rows):
            continue
        stay = (times[rows] - times[rows[0]]) // _MAX_STAY
        breaks = (np.diff(times[rows]) > _MAX_GAP) | (np.diff(stay) > 0)
        for part in np.split(rows, np.flatnonzero(breaks) + 1):
            if np.ptp(times[part]) >= _MIN_COMMON and len(np.unique(samples.sensor[part])) > 1:
                found.append(select_rows(samples, part))
    return found


def _join_tracks(samples: BodySamples, times: Array, places: Array, gate: float) -> Index:
    """(N,) number of the person of each sample: tracks are joined in order of their distance.

    Two tracks of one sensor at one time are of two persons.
    """
    rows = np.split(np.arange(len(times)), np.flatnonzero(np.diff(samples.track)) + 1)
    span = np.array([[times[r[0]], times[r[-1]]] for r in rows]).reshape(-1, 2)
    sensor = np.array([samples.sensor[r[0]] for r in rows])
    low, high = (np.array([reduce(places[r], axis=0) for r in rows]).reshape(-1, 2) for reduce in (np.min, np.max))
    pairs = []
    for a in range(len(rows)):
        common = np.minimum(span[a, 1], span[:, 1]) - np.maximum(span[a, 0], span[:, 0])
        # Tracks elsewhere are farther apart: most of them in large networks.
        apart = np.maximum(low - high[a], low[a] - high).max(axis=1, initial=-np.inf)
        near = (common >= _MIN_COMMON) & (sensor > sensor[a]) & (apart < gate)
        for b in np.flatnonzero(near).tolist():
            distance = _measure_distance(times, places, rows[a], rows[b])
            if distance < gate:
                pairs.append((distance, a, b))
    members = {k: [k] for k in range(len(rows))}
    person = np.arange(len(rows))
    for _, a, b in sorted(pairs):
        first, second = members[person[a]], members[person[b]]
        if person[a] != person[b] and not _contradict(first, second, sensor, span):
            person[second] = person[a]
            first.extend(second)
    return np.repeat(person, [len(r) for r in rows])


def _measure_distance(times: Array, places: Array, a: Index, b: Index) -> float:
    """Median distance of two tracks at the times of the first, m; infinite with too few of these."""
    inside = a[(times[a] >= times[b[0]]) & (times[a] <= times[b[-1]])]
    if len(inside) < 3:
        return np.inf
    other = np.column_stack([np.interp(times[inside], times[b], places[b, k]) for k in range(2)])
    return float(np.median(np.hypot(*(places[inside] - other).T)))


def _contradict(first: Sequence[int], second: Sequence[int], sensor: Index, span: Array) -> bool:
    """Whether one sensor measured both groups of tracks at the same time."""
    common = np.minimum(span[first, None, 1], span[None, second, 1]) - np.maximum(
        span[first, None, 0], span[None, second, 0]
    )
    return bool(np.any((sensor[first, None] == sensor[None, second]) & (common > _MAX_OVERLAP)))


def _has_support(sensor: Index, times: Array) -> Array:
    """(N,) whether another sensor has a sample near the time of each; times ascend."""
    supported = np.zeros(len(times), dtype=bool)
    for k in np.unique(sensor):
        own, others = sensor == k, times[sensor != k]
        if len(others):
            after = np.minimum(np.searchsorted(others, times[own]), len(others) - 1)
            before = np.maximum(after - 1, 0)
            gap = np.minimum(np.abs(others[after] - times[own]), np.abs(others[before] - times[own]))
            supported[own] = gap <= _SUPPORT
    return supported
