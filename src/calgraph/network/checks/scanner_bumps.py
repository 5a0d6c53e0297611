"""Findings about scanners of a network that were bumped during the recording."""

from collections.abc import Mapping

import numpy as np

from calgraph.errors import Rejected
from calgraph.network.tracking.track import ScannerBump, ScannerTracks
from calgraph.result.finding import Finding

# Intervals shorter than this are stated as one time, s.
_MAX_INSTANT = 1.5


def describe_bumps(
    root: str, followed: Mapping[str, ScannerTracks | Rejected], start: float
) -> tuple[Finding, ...]:
    """What moved, when, and from which data each of these scanners is calibrated.

    A pose from before the last bump is weak, as the scanner has moved since; if it is the root's, those of all
    scanners are.

    Args:
        root: name of the root.
        followed: the tracks of each scanner, or why it has none.
        start: of the recording, s.
    """
    return tuple(
        _describe(name, one, start, tuple(followed) if name == root else (name,), is_root=name == root)
        for name, one in followed.items()
        if isinstance(one, ScannerTracks) and one.bumps
    )


def _describe(
    name: str, tracks: ScannerTracks, start: float, depending: tuple[str, ...], *, is_root: bool
) -> Finding:
    """The finding about one scanner; the poses that depend on it are weak unless its last data suffice."""
    moved = f"{name} moved {', and '.join(_describe_step(bump, start) for bump in tracks.bumps)}"
    frame = ", and all poses are in its frame at that time" if is_root else ""
    begin, end = tracks.interval[0] - start, tracks.interval[1] - start
    if np.isinf(end):
        data = f"from its data after {begin:.1f} s"
        return Finding(f"{moved}: the result is its pose after that{frame}, {data}")
    return Finding(
        f"{moved}: its data after that are too short, the result is its pose between {max(begin, 0.0):.1f} and "
        f"{end:.1f} s{frame}: fix it to its place, and record again",
        depending,
    )


def _describe_step(bump: ScannerBump, start: float) -> str:
    begin, end = bump.interval[0] - start, bump.interval[1] - start
    time = (
        f"at {(begin + end) / 2:.1f} s" if end - begin < _MAX_INSTANT else f"between {begin:.1f} and {end:.1f} s"
    )
    if np.isnan(bump.translation):
        return f"{time}, by more than its background determines"
    translation = f"{1000 * bump.translation:.0f} ± {1000 * bump.translation_stddev:.0f} mm"
    rotation = f"{np.degrees(bump.rotation):+.2f} ± {np.degrees(bump.rotation_stddev):.2f}°"
    return f"by {translation} and {rotation} (±: one σ) {time}"
