"""Which tracks of which scanners are one body: those that were in the same place at the same time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from calgraph.geometry import Array, se2
from calgraph.tracking import Track, Tracked

# Tracks are compared this often, s.
_TICK = 0.1
# Two scanners see one body where their tracks are so near, m, at so many ticks, and in such a share of those at
# which both were there.
_NEAR = 0.5
_TICKS = 3
_SHARE = 0.5
# A scanner's track goes on in another one that begins within so long, s, and so far from where it led, m.
_GAP = 1.0
_LED = 0.4
# Tracks of one scanner at the same time for longer than this, s, are two bodies.
_BOTH = 0.15
# A body that nobody sees for longer is another one afterwards, s.
_UNSEEN = 1.5
# Shorter sights of a body say little, s.
_SHORTEST = 1.0


@dataclass(frozen=True, eq=False)
class Walker:
    """One body, from when it is seen until nobody sees it."""

    tracks: tuple[tuple[int, Track], ...]
    """Scanner and track, in order of time."""
    start: float
    """s."""
    end: float
    """s."""


@dataclass(frozen=True, eq=False)
class _Seen:
    """A track in the root's frame."""

    scanner: int
    track: Track
    ticks: Array
    places: Array
    """(T, 2) at the ticks."""


def walkers(tracked: Sequence[Tracked], T_root_scanner: Array) -> list[Walker]:
    """Groups the tracks of all scanners by the bodies they follow.

    Args:
        tracked: by scanner.
        T_root_scanner: (S, 3, 3) about where they are.

    Returns:
        Bodies that at least two scanners saw.
    """
    seen = [
        _in_root(s, track, T_root_scanner[s])
        for s, known in enumerate(tracked)
        for track in known.tracks
        if len(track.hits.times)
    ]
    of = {i: i for i in range(len(seen))}
    members = {i: [i] for i in range(len(seen))}
    for _, i, j in sorted([*_together(seen), *_going_on(seen)], key=lambda link: -link[0]):
        a, b = of[i], of[j]
        if a == b or _two_at_once([seen[k] for k in members[a]], [seen[k] for k in members[b]]):
            continue
        members[a] += members[b]
        of |= dict.fromkeys(members.pop(b), a)
    found = [part for group in members.values() for part in _unbroken([seen[k] for k in group])]
    return sorted((walker for walker in found if walker is not None), key=lambda walker: walker.start)


def _in_root(scanner: int, track: Track, T: Array) -> _Seen:
    ticks = np.arange(np.ceil(track.times[0] / _TICK), np.floor(track.times[-1] / _TICK) + 1)
    places = se2.apply(T, track.positions)
    at = np.column_stack([np.interp(ticks * _TICK, track.times, places[:, k]) for k in (0, 1)])
    return _Seen(scanner, track, ticks, at)


def _together(seen: Sequence[_Seen]) -> list[tuple[float, int, int]]:
    """Links between tracks of two scanners, with the number of ticks at which they were near."""
    owner = np.repeat(np.arange(len(seen)), [len(one.ticks) for one in seen])
    scanner = np.array([one.scanner for one in seen], dtype=np.intp)
    if not len(owner):
        return []
    ticks, places = np.concatenate([one.ticks for one in seen]), np.concatenate([one.places for one in seen])
    # Ticks as a third coordinate, so far apart that only what is of one tick is near.
    tree = cKDTree(np.column_stack([places, 10 * _NEAR * (ticks - ticks.min())]))
    i, j = owner[tree.query_pairs(_NEAR, output_type="ndarray").reshape(-1, 2)].T
    apart = scanner[i] != scanner[j]
    pairs, near = np.unique(np.sort(np.column_stack([i, j])[apart], axis=1), axis=0, return_counts=True)
    links = []
    for (first, second), count in zip(pairs.tolist(), near.tolist(), strict=True):
        a, b = seen[first].ticks, seen[second].ticks
        common = min(a[-1], b[-1]) - max(a[0], b[0]) + 1
        if count >= _TICKS and count >= _SHARE * common:
            links.append((float(count), first, second))
    return links


def _going_on(seen: Sequence[_Seen]) -> list[tuple[float, int, int]]:
    """Links between one scanner's tracks that continue each other, the nearer the stronger."""
    links = []
    by_scanner: dict[int, list[int]] = {}
    for i in sorted(range(len(seen)), key=lambda i: float(seen[i].track.times[0])):
        by_scanner.setdefault(seen[i].scanner, []).append(i)
    for own in by_scanner.values():
        starts = np.array([seen[i].track.times[0] for i in own])
        for i in own:
            end = seen[i].track
            low, high = np.searchsorted(starts, [end.times[-1], end.times[-1] + _GAP])
            for j in own[low:high]:
                begin = seen[j].track
                gap = begin.times[0] - end.times[-1]
                led = end.positions[-1] + gap * (end.velocities[-1] + begin.velocities[0]) / 2
                off = float(np.linalg.norm(begin.positions[0] - led))
                if off < _LED:
                    links.append(((1 - gap / _GAP) / _TICK * (1 - off / _LED), i, j))
    return links


def _two_at_once(group: Sequence[_Seen], other: Sequence[_Seen]) -> bool:
    """Whether some scanner saw both groups at the same time."""
    return any(
        a.scanner == b.scanner
        and min(a.track.times[-1], b.track.times[-1]) - max(a.track.times[0], b.track.times[0]) > _BOTH
        for a in group
        for b in other
    )


def _unbroken(group: Sequence[_Seen]) -> list[Walker | None]:
    """A body cut wherever nobody saw it for long; None for parts that one scanner alone or hardly any saw."""
    ordered = sorted(group, key=lambda one: float(one.track.times[0]))
    parts: list[list[_Seen]] = []
    until = -np.inf
    for one in ordered:
        if one.track.times[0] - until > _UNSEEN:
            parts.append([])
        parts[-1].append(one)
        until = max(until, float(one.track.times[-1]))
    return [_walker(part) for part in parts]


def _walker(part: Sequence[_Seen]) -> Walker | None:
    start = min(float(one.track.times[0]) for one in part)
    end = max(float(one.track.times[-1]) for one in part)
    if len({one.scanner for one in part}) < 2 or end - start < _SHORTEST:
        return None
    return Walker(tuple((one.scanner, one.track) for one in part), start, end)


def scanners_of(walker: Walker) -> Mapping[int, list[Track]]:
    """The tracks of a body by scanner."""
    own: dict[int, list[Track]] = {}
    for scanner, track in walker.tracks:
        own.setdefault(scanner, []).append(track)
    return own
