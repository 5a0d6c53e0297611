"""Tracks in a network at a moment."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.geometry import se3
from calgraph.result import Calibration
from calgraph.viewer.trails import compute_trails, recording_duration
from calgraph.viewer.view_state import ViewState


def test_without_a_moment_whole_tracks_are_shown(network: Calibration) -> None:
    found = compute_trails(network, ViewState(None))
    assert {name: len(trail.segments) for name, trail in found.items()} == {"a": 90, "b": 180}
    assert {name: len(trail.people) for name, trail in found.items()} == {"a": 0, "b": 0}


def test_people_are_at_their_positions(network: Calibration) -> None:
    """At 6 s, one person is 6 m up the hall; scanner b tracked another one who started 5 s later."""
    found = compute_trails(network, ViewState(6.0))
    np.testing.assert_allclose(found["a"].people, [[2, 6, 0]], atol=1e-6)
    people = se3.apply(network["b"].T_root_sensor, found["b"].people.astype(float))
    np.testing.assert_allclose(people, [[2, 6, 0], [2, 1, 0]], atol=1e-5)


def test_a_trail_ends_at_the_person(network: Calibration) -> None:
    """And reaches back 4 s, at 1 m/s."""
    segments = compute_trails(network, ViewState(6.0))["a"].segments
    np.testing.assert_allclose(segments[-1, 1], [2, 6, 0], atol=1e-6)
    assert segments[0, 0, 1] == pytest.approx(2, abs=0.11)


def test_people_who_left_are_not_shown(network: Calibration) -> None:
    assert compute_trails(network, ViewState(9.5))["a"].people == pytest.approx(np.array([[2, 9, 0]]), abs=1e-6)
    assert len(compute_trails(network, ViewState(10.5))["a"].people) == 0
    assert len(compute_trails(network, ViewState(14.0))["a"].segments) == 0


def test_a_network_lasts_until_the_last_walk_ends(network: Calibration) -> None:
    assert recording_duration(network) == 14


def test_walks_without_times_are_shown_whole(network: Calibration) -> None:
    floor = tuple(
        replace(v, times=tuple(np.full(len(w), np.nan) for w in v.tracks)) for v in network.pictures.floor_views
    )
    timeless = replace(network, pictures=replace(network.pictures, floor_views=floor))
    assert recording_duration(timeless) == 0
    assert len(compute_trails(timeless, ViewState(None))["a"].segments) == 90
