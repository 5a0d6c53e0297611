"""Tracks of successive intervals of a recording, joined to those of the whole."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from calgraph.errors import Rejected
from calgraph.geometry import Array
from calgraph.network.tracking.clusters import Foreground
from calgraph.network.tracking.track import ScannerBump, ScannerTracks

Tracked = Mapping[str, ScannerTracks | Rejected]
"""The tracks of each scanner, or why it has none."""


def join_tracks(intervals: Sequence[Tracked], max_gap: float) -> dict[str, ScannerTracks | Rejected]:
    """Joins the tracks of each scanner over intervals.

    What is tracked twice is of the earlier interval. A person who is in view when it ends has a track before and
    one after it; all else is as in tracks of the whole.

    Args:
        intervals: in order of time, one at least; all of the same scanners.
        max_gap: longest time without a scan between two intervals in which the scanner measured without a break,
            s.
    """
    return {name: _join_scanner([tracked[name] for tracked in intervals], max_gap) for name in intervals[0]}


def _join_scanner(found: Sequence[ScannerTracks | Rejected], max_gap: float) -> ScannerTracks | Rejected:
    parts = [one for one in found if isinstance(one, ScannerTracks)]
    if not parts:
        return found[-1]
    parts, bumps = _select_last_pose(parts)
    parts = [parts[0], *(_remove_overlap(one, before) for before, one in pairwise(parts))]
    if len(parts) == 1:
        return replace(parts[0], bumps=bumps)
    periods = np.cumsum([0, *(1 + max((track.period for track in one.tracks), default=-1) for one in parts)])
    tracks = tuple(
        replace(track, period=track.period + int(first))
        for first, one in zip(periods[:-1], parts, strict=True)
        for track in one.tracks
    )
    longest = max(parts, key=_covered_time)
    coverage = [one.coverage for one in parts if one.coverage is not None]
    return ScannerTracks(
        tracks,
        longest.background,
        longest.sigma,
        _join_coverage(np.concatenate(coverage), max_gap) if coverage else None,
        bumps,
        (parts[0].interval[0], parts[-1].interval[1]),
        _join_foregrounds([one.foreground for one in parts if one.foreground is not None]),
        longest.background_tested,
    )


def _select_last_pose(parts: list[ScannerTracks]) -> tuple[list[ScannerTracks], tuple[ScannerBump, ...]]:
    """The intervals after the last bump, which the one of the bump may belong to; and the bumps in it."""
    bumped = [k for k, one in enumerate(parts) if one.bumps]
    if not bumped:
        return parts, ()
    last = bumped[-1]
    is_after = parts[last].interval[1] == np.inf
    return parts[last if is_after or last == len(parts) - 1 else last + 1 :], parts[last].bumps


def _remove_overlap(tracked: ScannerTracks, before: ScannerTracks) -> ScannerTracks:
    """The tracks of an interval after the last scan of the one before, by the clock of the scanner."""
    if before.coverage is None or not len(before.coverage):
        return tracked
    last = float(before.coverage[-1, 1])
    return replace(tracked.select((np.nextafter(last, np.inf), np.inf)), interval=tracked.interval)


def _covered_time(tracked: ScannerTracks) -> float:
    return 0.0 if tracked.coverage is None else float(np.sum(np.diff(tracked.coverage, axis=1)))


def _join_coverage(coverage: Array, max_gap: float) -> Array:
    """Intervals (W, 2), s, of which those with less than ``max_gap`` between them are one."""
    breaks = np.flatnonzero(coverage[1:, 0] - coverage[:-1, 1] > max_gap)
    return np.column_stack([coverage[[0, *breaks + 1], 0], coverage[[*breaks, -1], 1]])


def _join_foregrounds(parts: Sequence[Foreground]) -> Foreground | None:
    """The beams of all parts, whose scans are numbered in their order."""
    if not parts:
        return None
    first = np.cumsum([0, *(len(one.spacing) for one in parts)])[:-1]
    numbered = [replace(one, scan=one.scan + start) for one, start in zip(parts, first, strict=True)]
    columns = {name: np.concatenate([vars(one)[name] for one in numbered]) for name in vars(numbered[0])}
    return Foreground(**columns)
