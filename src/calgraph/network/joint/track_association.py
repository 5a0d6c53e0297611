"""Groups the tracks of all scanners by the body that they follow: tracks at the same place at the same time."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from calgraph.geometry import Array, se2
from calgraph.network.pairs.synchronized_tracks import TICK_PERIOD
from calgraph.network.tracking.track import ScannerTracks, Track


@dataclass(frozen=True, eq=False)
class BodyTracks:
    """The tracks of one body."""

    tracks: tuple[tuple[int, Track], ...]
    """Scanner and track, in order of time."""
    start: float
    """s."""
    end: float
    """s."""

    def by_scanner(self) -> Mapping[int, list[Track]]:
        """The tracks of each scanner that has any."""
        grouped: dict[int, list[Track]] = {}
        for scanner, track in self.tracks:
            grouped.setdefault(scanner, []).append(track)
        return grouped


@dataclass(frozen=True, eq=False)
class _SampledTrack:
    """A track in the root frame, sampled at ticks."""

    scanner: int
    track: Track
    ticks: Array
    """(T,) multiples of the tick interval."""
    positions: Array
    """(T, 2) at the ticks, m."""


# Tracks of one scanner that overlap longer are of two bodies, s: a cluster may fall into two for about two scans
# of a scanner with 15 Hz.
_MAX_OVERLAP = 0.15
# Bodies that are tracked for a shorter time are not used, s: less than a stride, over which the deviations of a
# walking person average out.
_MIN_DURATION = 1.0


def group_tracks_by_body(tracked: Sequence[ScannerTracks], T_root_scanner: Array) -> list[BodyTracks]:
    """Groups the tracks of all scanners by body.

    Args:
        tracked: by scanner.
        T_root_scanner: (S, 3, 3) approximate poses.

    Returns:
        Bodies that at least two scanners tracked, in order of time.
    """
    sampled = [
        _sample_track(scanner, track, T_root_scanner[scanner])
        for scanner, found in enumerate(tracked)
        for track in found.tracks
        if len(track.hits.times)
    ]
    group_of = {i: i for i in range(len(sampled))}
    members = {i: [i] for i in range(len(sampled))}
    links = [*_link_simultaneous(sampled), *_link_successive(sampled)]
    for _, i, j in sorted(links, key=lambda link: -link[0]):
        a, b = group_of[i], group_of[j]
        if a == b:
            continue
        group, other = ([sampled[k] for k in members[one]] for one in (a, b))
        if _overlap_in_scanner(group, other):
            continue
        members[a] += members[b]
        group_of |= dict.fromkeys(members.pop(b), a)
    bodies = []
    for indices in members.values():
        tracks = sorted((sampled[k] for k in indices), key=lambda one: float(one.track.times[0]))
        start, end = tracks[0].track.times[0], max(one.track.times[-1] for one in tracks)
        if len({one.scanner for one in tracks}) >= 2 and end - start >= _MIN_DURATION:
            bodies.append(BodyTracks(tuple((one.scanner, one.track) for one in tracks), float(start), float(end)))
    return sorted(bodies, key=lambda body: body.start)


def _sample_track(scanner: int, track: Track, T: Array) -> _SampledTrack:
    ticks = np.arange(np.ceil(track.times[0] / TICK_PERIOD), np.floor(track.times[-1] / TICK_PERIOD) + 1)
    positions = se2.apply(T, track.positions)
    at_ticks = np.column_stack([np.interp(ticks * TICK_PERIOD, track.times, positions[:, k]) for k in (0, 1)])
    return _SampledTrack(scanner, track, ticks, at_ticks)


# Simultaneous positions of one body in two scanners are at most this far apart, m. People keep about half a metre
# from each other; the errors of start poses, centres and clocks are smaller (50 ms of clock at 1.5 m/s are 8 cm).
MAX_DISTANCE = 0.5
# Ticks (TICK_PERIOD of pairs) at which two tracks have to be this close: two people who pass each other at 2.5
# m/s relative speed are close for at most 4, and the share below decides then.
_MIN_TICKS = 3
# Share of the common ticks at which two tracks have to be close: the majority, so that a track is not linked to
# two people who walk apart.
_MIN_SHARE = 0.5


def _link_simultaneous(sampled: Sequence[_SampledTrack]) -> list[tuple[float, int, int]]:
    """Links between tracks of two scanners.

    Their strength is the number of ticks at which they are close, the closer the more: for a minute, people who
    walk side by side are within the distance that is close enough for one.
    """
    owner = np.repeat(np.arange(len(sampled)), [len(one.ticks) for one in sampled])
    scanner = np.array([one.scanner for one in sampled], dtype=np.intp)
    if not len(owner):
        return []
    ticks = np.concatenate([one.ticks for one in sampled])
    positions = np.concatenate([one.positions for one in sampled])
    # Ticks are a third coordinate, scaled so that only samples of one tick are neighbours.
    tree = cKDTree(np.column_stack([positions, 10 * MAX_DISTANCE * (ticks - ticks.min())]))
    samples = tree.query_pairs(MAX_DISTANCE, output_type="ndarray").reshape(-1, 2)
    samples = samples[scanner[owner[samples[:, 0]]] != scanner[owner[samples[:, 1]]]]
    distances = np.linalg.norm(positions[samples[:, 0]] - positions[samples[:, 1]], axis=1)
    pairs, pair_of_samples, close_ticks = np.unique(
        np.sort(owner[samples], axis=1), axis=0, return_inverse=True, return_counts=True
    )
    closeness = np.bincount(pair_of_samples.ravel(), 1 - (distances / MAX_DISTANCE) ** 2, minlength=len(pairs))
    links = []
    for (first, second), count, strength in zip(
        pairs.tolist(), close_ticks.tolist(), closeness.tolist(), strict=True
    ):
        a, b = sampled[first].ticks, sampled[second].ticks
        common = min(a[-1], b[-1]) - max(a[0], b[0]) + 1
        if count >= _MIN_TICKS and count >= _MIN_SHARE * common:
            links.append((strength, first, second))
    return links


# A track continues an earlier one of its scanner after at most this time, s: longer than people hide each other
# when they pass. After longer ones, a body counts as another one.
_MAX_GAP = 1.0
# Distance of a continuing track from the extrapolation, m: one standard deviation of an extrapolation over 1 s at
# an acceleration density q of 0.5 m²/s³, sqrt(q t³ / 3).
_MAX_JUMP = 0.4


def _link_successive(sampled: Sequence[_SampledTrack]) -> list[tuple[float, int, int]]:
    """Links between tracks of one scanner that continue each other: the closer, the stronger."""
    links = []
    by_scanner: dict[int, list[int]] = {}
    for i in sorted(range(len(sampled)), key=lambda i: float(sampled[i].track.times[0])):
        by_scanner.setdefault(sampled[i].scanner, []).append(i)
    for indices in by_scanner.values():
        starts = np.array([sampled[i].track.times[0] for i in indices])
        for i in indices:
            earlier = sampled[i].track
            low, high = np.searchsorted(starts, [earlier.times[-1], earlier.times[-1] + _MAX_GAP])
            for j in indices[low:high]:
                later = sampled[j].track
                gap = later.times[0] - earlier.times[-1]
                extrapolated = earlier.positions[-1] + gap * (earlier.velocities[-1] + later.velocities[0]) / 2
                jump = float(np.linalg.norm(later.positions[0] - extrapolated))
                if jump < _MAX_JUMP:
                    links.append(((1 - gap / _MAX_GAP) / TICK_PERIOD * (1 - jump / _MAX_JUMP), i, j))
    return links


def _overlap_in_scanner(group: Sequence[_SampledTrack], other: Sequence[_SampledTrack]) -> bool:
    """Whether some scanner tracked both groups at the same time for too long."""
    intervals: dict[int, list[tuple[float, float]]] = {}
    for one in group:
        intervals.setdefault(one.scanner, []).append((one.track.times[0], one.track.times[-1]))
    return any(
        min(end, one.track.times[-1]) - max(start, one.track.times[0]) > _MAX_OVERLAP
        for one in other
        for start, end in intervals.get(one.scanner, ())
    )


def cut_bodies(bodies: Sequence[BodyTracks]) -> list[BodyTracks]:
    """The bodies, with parts of equal duration in the place of those that many scanners measured.

    Parts that fewer than two scanners measured are left out.
    """
    return [part for body in bodies for part in _cut_body(body)]


# Maximum duration of a part, s: people walk through the views of a dozen scanners in this time. A cut loses the
# smoothness of two control points out of 300. Parts of 20 s make the clocks 4 % less certain.
_MAX_DURATION = 60.0
# Bodies that fewer scanners measured are not cut: they cost little.
_MIN_SCANNERS = 9


def _cut_body(body: BodyTracks) -> Iterator[BodyTracks]:
    count = int(np.ceil((body.end - body.start) / _MAX_DURATION))
    if count < 2 or len(body.by_scanner()) < _MIN_SCANNERS:
        yield body
        return
    cuts = np.linspace(body.start, body.end, count + 1)[1:-1].tolist()
    for begin, end in zip([-np.inf, *cuts], [*cuts, np.inf], strict=True):
        # A scan at the cut is of the later part.
        selected = [(scanner, track.select((begin, np.nextafter(end, -np.inf)))) for scanner, track in body.tracks]
        tracks = tuple((scanner, track) for scanner, track in selected if len(track.times))
        if len({scanner for scanner, _ in tracks}) >= 2:
            start = min(float(track.times[0]) for _, track in tracks)
            yield BodyTracks(tracks, start, max(float(track.times[-1]) for _, track in tracks))
