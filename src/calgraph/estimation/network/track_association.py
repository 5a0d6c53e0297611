"""Groups the tracks of all scanners by the body that they follow: tracks at the same place at the same time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from calgraph.geometry import Array, se2
from calgraph.tracking import ScannerTracks, Track

# Interval at which tracks are compared, s.
_TICK = 0.1
# Tracks of two scanners follow one body if they are within this distance, m, at this many ticks, and at this share
# of the ticks that they have in common.
_MAX_DISTANCE = 0.5
_MIN_TICKS = 3
_MIN_SHARE = 0.5
# A track continues another one of the same scanner if the gap is shorter than this, s, and the extrapolated
# position is within this distance, m.
_MAX_GAP = 1.0
_MAX_JUMP = 0.4
# Tracks of one scanner that overlap for longer than this, s, are of two bodies.
_MAX_OVERLAP = 0.15
# A body that no scanner tracks for longer than this, s, counts as another one afterwards.
_MAX_UNTRACKED = 1.5
# Bodies tracked for a shorter time than this, s, are not used.
_MIN_DURATION = 1.0


@dataclass(frozen=True, eq=False)
class BodyTracks:
    """The tracks of one body without a long interruption."""

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
    for _, i, j in sorted([*_link_simultaneous(sampled), *_link_successive(sampled)], key=lambda link: -link[0]):
        a, b = group_of[i], group_of[j]
        if a == b or _overlap_in_scanner([sampled[k] for k in members[a]], [sampled[k] for k in members[b]]):
            continue
        members[a] += members[b]
        group_of |= dict.fromkeys(members.pop(b), a)
    bodies = [part for group in members.values() for part in _split_at_gaps([sampled[k] for k in group])]
    return sorted((body for body in bodies if body is not None), key=lambda body: body.start)


def _sample_track(scanner: int, track: Track, T: Array) -> _SampledTrack:
    ticks = np.arange(np.ceil(track.times[0] / _TICK), np.floor(track.times[-1] / _TICK) + 1)
    positions = se2.apply(T, track.positions)
    at_ticks = np.column_stack([np.interp(ticks * _TICK, track.times, positions[:, k]) for k in (0, 1)])
    return _SampledTrack(scanner, track, ticks, at_ticks)


def _link_simultaneous(sampled: Sequence[_SampledTrack]) -> list[tuple[float, int, int]]:
    """Links between tracks of two scanners; their strength is the number of ticks at which they are close."""
    owner = np.repeat(np.arange(len(sampled)), [len(one.ticks) for one in sampled])
    scanner = np.array([one.scanner for one in sampled], dtype=np.intp)
    if not len(owner):
        return []
    ticks = np.concatenate([one.ticks for one in sampled])
    positions = np.concatenate([one.positions for one in sampled])
    # Ticks are a third coordinate, scaled so that only samples of one tick are neighbours.
    tree = cKDTree(np.column_stack([positions, 10 * _MAX_DISTANCE * (ticks - ticks.min())]))
    i, j = owner[tree.query_pairs(_MAX_DISTANCE, output_type="ndarray").reshape(-1, 2)].T
    different = scanner[i] != scanner[j]
    pairs, close_ticks = np.unique(np.sort(np.column_stack([i, j])[different], axis=1), axis=0, return_counts=True)
    links = []
    for (first, second), count in zip(pairs.tolist(), close_ticks.tolist(), strict=True):
        a, b = sampled[first].ticks, sampled[second].ticks
        common = min(a[-1], b[-1]) - max(a[0], b[0]) + 1
        if count >= _MIN_TICKS and count >= _MIN_SHARE * common:
            links.append((float(count), first, second))
    return links


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
                    links.append(((1 - gap / _MAX_GAP) / _TICK * (1 - jump / _MAX_JUMP), i, j))
    return links


def _overlap_in_scanner(group: Sequence[_SampledTrack], other: Sequence[_SampledTrack]) -> bool:
    """Whether some scanner tracked both groups at the same time."""
    return any(
        a.scanner == b.scanner
        and min(a.track.times[-1], b.track.times[-1]) - max(a.track.times[0], b.track.times[0]) > _MAX_OVERLAP
        for a in group
        for b in other
    )


def _split_at_gaps(group: Sequence[_SampledTrack]) -> list[BodyTracks | None]:
    """A body split where no scanner tracked it for long; None for parts that are not used."""
    parts: list[list[_SampledTrack]] = []
    end = -np.inf
    for one in sorted(group, key=lambda one: float(one.track.times[0])):
        if one.track.times[0] - end > _MAX_UNTRACKED:
            parts.append([])
        parts[-1].append(one)
        end = max(end, float(one.track.times[-1]))
    return [_build_body(part) for part in parts]


def _build_body(part: Sequence[_SampledTrack]) -> BodyTracks | None:
    start = min(float(one.track.times[0]) for one in part)
    end = max(float(one.track.times[-1]) for one in part)
    if len({one.scanner for one in part}) < 2 or end - start < _MIN_DURATION:
        return None
    return BodyTracks(tuple((one.scanner, one.track) for one in part), start, end)
