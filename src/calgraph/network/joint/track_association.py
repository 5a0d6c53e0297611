"""Groups the tracks of all scanners by the body that they follow: tracks at the same place at the same time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from calgraph.config.settings import TrackGroupingSettings
from calgraph.geometry import Array, se2
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


def group_tracks_by_body(
    tracked: Sequence[ScannerTracks], T_root_scanner: Array, tick_period: float, settings: TrackGroupingSettings
) -> list[BodyTracks]:
    """Groups the tracks of all scanners by body.

    Args:
        tracked: by scanner.
        T_root_scanner: (S, 3, 3) approximate poses.
        tick_period: interval at which tracks are compared, s.
        settings: of the grouping.

    Returns:
        Bodies that at least two scanners tracked, in order of time.
    """
    sampled = [
        _sample_track(scanner, track, T_root_scanner[scanner], tick_period)
        for scanner, found in enumerate(tracked)
        for track in found.tracks
        if len(track.hits.times)
    ]
    group_of = {i: i for i in range(len(sampled))}
    members = {i: [i] for i in range(len(sampled))}
    links = [*_link_simultaneous(sampled, settings), *_link_successive(sampled, tick_period, settings)]
    for _, i, j in sorted(links, key=lambda link: -link[0]):
        a, b = group_of[i], group_of[j]
        if a == b:
            continue
        group, other = ([sampled[k] for k in members[one]] for one in (a, b))
        if _overlap_in_scanner(group, other, settings.max_overlap):
            continue
        members[a] += members[b]
        group_of |= dict.fromkeys(members.pop(b), a)
    bodies = []
    for indices in members.values():
        tracks = sorted((sampled[k] for k in indices), key=lambda one: float(one.track.times[0]))
        start, end = tracks[0].track.times[0], max(one.track.times[-1] for one in tracks)
        if len({one.scanner for one in tracks}) >= 2 and end - start >= settings.min_duration:
            bodies.append(BodyTracks(tuple((one.scanner, one.track) for one in tracks), float(start), float(end)))
    return sorted(bodies, key=lambda body: body.start)


def _sample_track(scanner: int, track: Track, T: Array, tick_period: float) -> _SampledTrack:
    ticks = np.arange(np.ceil(track.times[0] / tick_period), np.floor(track.times[-1] / tick_period) + 1)
    positions = se2.apply(T, track.positions)
    at_ticks = np.column_stack([np.interp(ticks * tick_period, track.times, positions[:, k]) for k in (0, 1)])
    return _SampledTrack(scanner, track, ticks, at_ticks)


def _link_simultaneous(
    sampled: Sequence[_SampledTrack], settings: TrackGroupingSettings
) -> list[tuple[float, int, int]]:
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
    tree = cKDTree(np.column_stack([positions, 10 * settings.max_distance * (ticks - ticks.min())]))
    samples = tree.query_pairs(settings.max_distance, output_type="ndarray").reshape(-1, 2)
    samples = samples[scanner[owner[samples[:, 0]]] != scanner[owner[samples[:, 1]]]]
    distances = np.linalg.norm(positions[samples[:, 0]] - positions[samples[:, 1]], axis=1)
    pairs, pair_of_samples, close_ticks = np.unique(
        np.sort(owner[samples], axis=1), axis=0, return_inverse=True, return_counts=True
    )
    closeness = np.bincount(
        pair_of_samples.ravel(), 1 - (distances / settings.max_distance) ** 2, minlength=len(pairs)
    )
    links = []
    for (first, second), count, strength in zip(
        pairs.tolist(), close_ticks.tolist(), closeness.tolist(), strict=True
    ):
        a, b = sampled[first].ticks, sampled[second].ticks
        common = min(a[-1], b[-1]) - max(a[0], b[0]) + 1
        if count >= settings.min_ticks and count >= settings.min_share * common:
            links.append((strength, first, second))
    return links


def _link_successive(
    sampled: Sequence[_SampledTrack], tick_period: float, settings: TrackGroupingSettings
) -> list[tuple[float, int, int]]:
    """Links between tracks of one scanner that continue each other: the closer, the stronger."""
    links = []
    by_scanner: dict[int, list[int]] = {}
    for i in sorted(range(len(sampled)), key=lambda i: float(sampled[i].track.times[0])):
        by_scanner.setdefault(sampled[i].scanner, []).append(i)
    for indices in by_scanner.values():
        starts = np.array([sampled[i].track.times[0] for i in indices])
        for i in indices:
            earlier = sampled[i].track
            low, high = np.searchsorted(starts, [earlier.times[-1], earlier.times[-1] + settings.max_gap])
            for j in indices[low:high]:
                later = sampled[j].track
                gap = later.times[0] - earlier.times[-1]
                extrapolated = earlier.positions[-1] + gap * (earlier.velocities[-1] + later.velocities[0]) / 2
                jump = float(np.linalg.norm(later.positions[0] - extrapolated))
                if jump < settings.max_jump:
                    links.append(
                        ((1 - gap / settings.max_gap) / tick_period * (1 - jump / settings.max_jump), i, j)
                    )
    return links


def _overlap_in_scanner(
    group: Sequence[_SampledTrack], other: Sequence[_SampledTrack], max_overlap: float
) -> bool:
    """Whether some scanner tracked both groups at the same time for longer than ``max_overlap``, s."""
    intervals: dict[int, list[tuple[float, float]]] = {}
    for one in group:
        intervals.setdefault(one.scanner, []).append((one.track.times[0], one.track.times[-1]))
    return any(
        min(end, one.track.times[-1]) - max(start, one.track.times[0]) > max_overlap
        for one in other
        for start, end in intervals.get(one.scanner, ())
    )
