"""Poses under which people pass a scanner unnoticed that could not have overlooked them."""

import numpy as np
import pytest

from calgraph.geometry import Array, se2
from calgraph.pairwise.synchronized_tracks import TrackSamples, pair_samples
from calgraph.pairwise.visibility_map import (
    VisibilityMap,
    build_visibility_map,
    contradicts_visibility,
    is_free_space,
)
from calgraph.tracking import ScannerTracks

NOBODY = TrackSamples(*(np.zeros(0, dtype=np.intp),) * 2, *(np.zeros((0, 2)),) * 2, np.zeros((0, 2, 2)))


def wall(distance: float, beams: int = 540) -> Array:
    """(N, 2) what a scanner in the middle of a round hall sees."""
    angle = np.linspace(-np.pi, np.pi, beams)
    return distance * np.column_stack([np.cos(angle), np.sin(angle)])


def walks(positions: Array, first: int = 0) -> TrackSamples:
    """Samples of one walk, tick by tick."""
    ticks = np.arange(first, first + len(positions))
    S = np.tile(0.02**2 * np.eye(2), (len(positions), 1, 1))
    return TrackSamples(
        ticks, np.zeros(len(positions), np.intp), positions, np.gradient(positions, 0.1, axis=0), S
    )


def still(background: Array, watched: Array | None = None) -> ScannerTracks:
    return ScannerTracks((), background, 0.01, watched)


def circle(radius: float, ticks: int = 100) -> Array:
    angle = np.linspace(0, 2 * np.pi, ticks)
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize(("distance", "past"), [(0.5, True), (4.0, True), (4.8, False), (9.0, False)])
def test_a_scanner_looks_past_what_is_nearer_than_the_wall(distance: float, past: bool) -> None:
    assert is_free_space(wall(5.0), distance * circle(1.0), 0.3).all() == past
    assert is_free_space(wall(5.0), distance * circle(1.0), 0.3).any() == past


def test_nobody_knows_what_is_where_no_beam_came_back() -> None:
    half = wall(5.0)[:270]  # below the x axis
    assert is_free_space(half, np.array([[0.0, -3.0], [0.0, 3.0]]), 0.3).tolist() == [True, False]
    assert not is_free_space(np.zeros((0, 2)), circle(1.0), 0.3).any()
    assert not is_free_space(np.full((4, 2), np.nan), circle(1.0), 0.3).any()


def test_beams_on_either_side_of_an_edge_show_only_what_is_before_both() -> None:
    edge = np.array([[3.0, -0.01], [8.0, 0.01]])
    assert is_free_space(edge, np.array([[2.0, 0.0], [5.0, 0.0]]), 0.3).tolist() == [True, False]


def test_the_view_is_open_as_far_as_people_are_usually_seen() -> None:
    view = build_visibility_map(still(wall(9.0)), walks(circle(4.0)))
    assert view.covers(circle(3.7)).all()
    assert not view.covers(circle(5.0)).any()


def test_the_view_is_open_where_somebody_was_seen_even_with_nothing_behind() -> None:
    view = build_visibility_map(still(np.zeros((0, 2))), walks(circle(4.0, ticks=300)))
    assert view.covers(circle(4.0, ticks=300)).mean() > 0.95
    assert not view.covers(circle(3.0)).any()


def test_nothing_is_open_to_a_scanner_that_saw_nobody() -> None:
    view = build_visibility_map(still(wall(9.0)), NOBODY)
    assert not view.covers(np.concatenate([circle(r) for r in (0.0, 0.1, 1.0, 1e6)])).any()


def test_what_is_far_out_of_the_map_is_not_open() -> None:
    view = VisibilityMap(np.pad(np.ones((20, 20), dtype=np.bool_), 1), np.zeros((0, 2)))
    assert view.covers(np.array([[0.0, 0.0], [1.9, -1.9]])).all()
    assert not view.covers(np.array([[2.1, 0.0], [-1e9, 0.0], [0.0, 1e9]])).any()


def test_a_pose_is_refuted_by_people_who_pass_the_other_scanner_unnoticed() -> None:
    # b stands 2 m to the right of a; both see the same walk, about b, and halls around them.
    T_a_b = se2.pose(0.0, np.array([2.0, 0.0]))
    b = walks(circle(3.0))
    a = walks(se2.apply(T_a_b, b.positions))
    views = build_visibility_map(still(wall(12.0)), a), build_visibility_map(still(wall(12.0)), b)
    wrong = se2.pose(np.pi, np.array([2.0, 0.0]))  # the other half of the circle at every time
    found = contradicts_visibility(
        np.array([T_a_b, wrong]),
        pair_samples(a, b),
        *views,
        radius=0.5,
        min_expected=20,
        max_missed_share=0.5,
    )
    assert found.tolist() == [False, True]


def test_poses_with_views_apart_are_refuted_by_nobody() -> None:
    a, b = walks(circle(3.0)), walks(circle(3.0))
    views = build_visibility_map(still(wall(4.0)), a), build_visibility_map(still(wall(4.0)), b)
    far = se2.pose(0.3, np.array([20.0, 0.0]))
    assert contradicts_visibility(
        far[None], pair_samples(a, b), *views, radius=0.5, min_expected=20, max_missed_share=0.5
    ).tolist() == [False]
    assert contradicts_visibility(
        np.zeros((0, 3, 3)),
        pair_samples(a, b),
        *views,
        radius=0.5,
        min_expected=20,
        max_missed_share=0.5,
    ).shape == (0,)


def test_nobody_is_missed_while_the_other_scanner_did_not_measure() -> None:
    # What b saw ended before a's second half, under a pose that is right.
    x = circle(3.0, ticks=200)
    a, b = walks(x), walks(x[:60])
    views = build_visibility_map(still(wall(12.0)), a), build_visibility_map(still(wall(12.0)), b)
    assert contradicts_visibility(
        np.eye(3)[None], pair_samples(a, b), *views, radius=0.5, min_expected=20, max_missed_share=0.5
    ).tolist() == [False]


def test_who_passes_while_the_other_scanner_measured_and_saw_nobody_is_missed() -> None:
    x = np.concatenate([circle(3.0, ticks=60), circle(2.0, ticks=140)])
    a, b = walks(x), walks(x[:60])
    watched = np.array([[0.0, 20.0]])
    views = (
        build_visibility_map(still(wall(12.0), watched), a),
        build_visibility_map(still(wall(12.0), watched), b),
    )
    assert contradicts_visibility(
        np.eye(3)[None], pair_samples(a, b), *views, radius=0.5, min_expected=20, max_missed_share=0.5
    ).tolist() == [True]


@pytest.mark.parametrize(("time", "there"), [(0.9, False), (1.0, True), (2.5, False), (3.5, True), (4.1, False)])
def test_a_scanner_watches_but_not_in_its_breaks(time: float, there: bool) -> None:
    view = build_visibility_map(still(wall(9.0), np.array([[1.0, 2.0], [3.0, 4.0]])), NOBODY)
    assert view.measures_at(np.array([time])).tolist() == [there]
