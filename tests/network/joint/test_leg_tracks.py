"""Tracks of legs over all scanners, and the association of beams with them."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.config import People
from calgraph.config.settings import LegSettings
from calgraph.geometry import Array
from calgraph.network.joint.leg_solution import LegCandidate, associate_beams, initialize_leg, predict_headings
from calgraph.network.joint.leg_tracks import track_legs
from calgraph.network.joint.legs import measures_legs
from calgraph.network.joint.scanner_unknowns import RANGE_BIAS, SYSTEMATIC_ERRORS
from calgraph.network.joint.splines import evaluate_spline
from calgraph.network.tracking.clusters import Foreground
from calgraph.network.tracking.leg_clusters import cluster_legs
from calgraph.network.tracking.track import ScannerTracks
from leg_scenes import DURATION, OFFSET, T_ROOT, build_foreground, build_path, walk_leg

SETTINGS = LegSettings()
EXACT = np.zeros(len(SYSTEMATIC_ERRORS))


def test_both_legs_are_tracked_through_all_scanners() -> None:
    clusters = [cluster_legs(build_foreground(s), 0.01) for s in range(3)]
    tracks = track_legs(clusters, T_ROOT, OFFSET)
    assert len(tracks) == 2
    for track in tracks:
        leg = initialize_leg(track)
        times = np.linspace(leg.start, leg.end, 50)
        first, weights, _ = leg.knots.basis_at(times)
        positions = evaluate_spline(leg.path.control[:, :2], first, weights)
        errors = [np.linalg.norm(positions - walk_leg(side, times)[:, :2], axis=1).mean() for side in (-1.0, 1.0)]
        assert min(errors) < 0.02
        assert track.times[-1] - track.times[0] > 0.8 * DURATION


def test_a_leg_that_stands_is_not_tracked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.network.joint.leg_tracks._MIN_TRAVEL", 5.0)
    clusters = [cluster_legs(build_foreground(s), 0.01) for s in range(3)]
    assert track_legs(clusters, T_ROOT, OFFSET) == []


def build_legs() -> list[LegCandidate]:
    legs = []
    for side in (-1.0, 1.0):
        knots, path = build_path(side)
        legs.append(LegCandidate(knots, 0.0, DURATION, path))
    return legs


def count_beams(beams: Foreground, legs: list[LegCandidate], systematic: Array = EXACT) -> list[int]:
    """Of the first scanner on each leg."""
    of_legs = associate_beams(beams, 0, T_ROOT[0], 0.0, systematic, 0.01, legs)
    return [len(scans.ranges) if scans else 0 for scans in of_legs]


def test_beams_go_to_the_nearest_leg_and_ambiguous_ones_to_none() -> None:
    legs = build_legs()
    beams = build_foreground(0)
    counts = count_beams(beams, legs)
    assert min(counts) > 0
    assert sum(counts) > 0.8 * len(beams.ranges)
    assert count_beams(beams, [legs[0], legs[0]]) == [0, 0]


def test_systematic_errors_are_corrected_before_beams_are_associated() -> None:
    """Ranges 20 cm too long end behind the legs, a few of them at the other leg."""
    legs, exact = build_legs(), build_foreground(0)
    beams = replace(exact, ranges=exact.ranges + 0.2)
    bias = EXACT.copy()
    bias[RANGE_BIAS] = 0.2
    assert sum(count_beams(beams, legs)) < 0.2 * len(beams.ranges)
    assert count_beams(beams, legs, bias) == count_beams(exact, legs)


def test_heading_is_the_direction_over_a_stride() -> None:
    knots, path = build_path(1.0)
    heading, information = predict_headings(path.control[:, :2], knots.step)
    middle = slice(12, -12)
    assert np.abs(heading[middle] - 0.3).max() < 0.1
    assert (information[middle] > 0).all()
    standing = np.tile(path.control[:1, :2], (40, 1))
    assert not predict_headings(standing, knots.step)[1].any()


def test_narrow_objects_are_legs_unless_a_height_is_stated() -> None:
    tracked = [ScannerTracks((), np.zeros((0, 2)), 0.01, foreground=build_foreground(s)) for s in range(3)]
    assert measures_legs(People(), tracked, SETTINGS)
    assert not measures_legs(People(height=1.0), tracked, SETTINGS)
    assert measures_legs(People(height=0.3), tracked, SETTINGS)
