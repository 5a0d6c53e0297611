"""Arcs of the size of a leg among foreground beams."""

import numpy as np
import pytest

from calgraph.network.tracking.leg_clusters import cluster_legs, measure_widths
from calgraph.network.tracking.track import ScannerTracks, correct_tracks
from leg_scenes import OFFSET, build_foreground, scan_times, walk_leg


def test_centres_are_those_of_the_legs() -> None:
    clusters = cluster_legs(build_foreground(0), 0.01)
    assert len(clusters.times) > 50
    legs = np.stack([walk_leg(side, clusters.times - OFFSET[0])[:, :2] for side in (-1.0, 1.0)])
    errors = np.linalg.norm(legs - clusters.centers, axis=2).min(axis=0)
    assert np.median(errors) < 0.01


def test_wide_arcs_are_no_legs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.network.tracking.leg_clusters._MAX_WIDTH", 0.04)
    assert len(cluster_legs(build_foreground(0), 0.0).times) < 5


def test_widths_are_below_those_of_bodies() -> None:
    widths = measure_widths(build_foreground(0), 0.01)
    assert np.median(widths) == pytest.approx(0.11, abs=0.02)
    assert len(scan_times(0)) < len(widths)


def test_no_beams_are_no_clusters() -> None:
    beams = build_foreground(0)
    empty = type(beams)(*(getattr(beams, name)[:0] for name in beams.__dataclass_fields__))
    assert len(cluster_legs(empty, 0.01).times) == 0
    assert len(measure_widths(empty, 0.01)) == 0


def test_corrected_tracks_have_a_corrected_foreground() -> None:
    beams = build_foreground(0)
    tracked = ScannerTracks((), np.zeros((0, 2)), 0.01, foreground=beams)
    corrected = correct_tracks(tracked, clock_offset=0.5, inverted=True).foreground
    assert corrected is not None
    assert corrected.times == pytest.approx(beams.times - 0.5)
    assert corrected.angles == pytest.approx(-beams.angles)
