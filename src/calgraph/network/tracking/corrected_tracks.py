"""Tracks of a scanner as if its clock were set and it were mounted upright."""

from dataclasses import replace

import numpy as np

from calgraph.geometry import Array
from calgraph.network.tracking.clusters import Foreground
from calgraph.network.tracking.track import ScannerTracks, Track


def correct_tracks(tracked: ScannerTracks, *, clock_offset: float = 0.0, inverted: bool = False) -> ScannerTracks:
    """The same tracks with times of another clock, and in the frame of a scanner mounted the other way up.

    A scanner that is mounted upside-down observes the plane from below. The frame that is rotated by 180° about
    its x axis has the same x and the opposite y and angles. Bumps keep the scanner's clock and frame.

    Args:
        tracked: tracks, beams and background of a scanner.
        clock_offset: the scanner's clock minus the other clock, s.
        inverted: whether to mirror everything at the x axis.
    """
    if not clock_offset and not inverted:
        return tracked
    signs = np.array([1.0, -1.0 if inverted else 1.0])
    # Static points are in order of angle, which mirroring reverses.
    background = tracked.background[::-1] if inverted else tracked.background
    return replace(
        tracked,
        tracks=tuple(_correct_track(track, clock_offset, signs) for track in tracked.tracks),
        background=background * signs,
        coverage=None if tracked.coverage is None else tracked.coverage - clock_offset,
        foreground=tracked.foreground and _correct_foreground(tracked.foreground, clock_offset, signs),
    )


def _correct_foreground(foreground: Foreground, clock_offset: float, signs: Array) -> Foreground:
    return replace(foreground, angles=foreground.angles * signs[1], times=foreground.times - clock_offset)


def _correct_track(track: Track, clock_offset: float, signs: Array) -> Track:
    return replace(
        track,
        times=track.times - clock_offset,
        positions=track.positions * signs,
        velocities=track.velocities * signs,
        covariances=track.covariances * np.outer(signs, signs),
        hits=replace(track.hits, points=track.hits.points * signs, times=track.hits.times - clock_offset),
    )
