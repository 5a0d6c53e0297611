"""Visibility maps, and poses that imply missed detections."""

import numpy as np
import pytest

from calgraph.geometry import Array, se2
from calgraph.network.pairs import visibility_map
from calgraph.network.pairs.synchronized_tracks import TrackSamples, pair_samples
from calgraph.network.pairs.visibility_map import (
    Flags,
    ScannerObservations,
    VisibilityMap,
    build_visibility_map,
    find_missed_detections,
    is_free_space,
    miss_detections,
)
from calgraph.network.tracking.track import ScannerTracks

NO_SAMPLES = TrackSamples(*(np.zeros(0, dtype=np.intp),) * 2, *(np.zeros((0, 2)),) * 2, np.zeros((0, 2, 2)))


def wall(distance: float, beams: int = 540) -> Array:
    """(N, 2) background points of a scanner in the centre of a circular hall."""
    angle = np.linspace(-np.pi, np.pi, beams)
    return distance * np.column_stack([np.cos(angle), np.sin(angle)])


def walks(positions: Array, first: int = 0) -> TrackSamples:
    """Samples of one walk, tick by tick."""
    ticks = np.arange(first, first + len(positions))
    S = np.tile(0.02**2 * np.eye(2), (len(positions), 1, 1))
    return TrackSamples(
        ticks, np.zeros(len(positions), np.intp), positions, np.gradient(positions, 0.1, axis=0), S
    )


def refute(T_a_b: Array, a: TrackSamples, b: TrackSamples, view_a: VisibilityMap, view_b: VisibilityMap) -> Flags:
    """Which poses imply too many missed detections."""
    pairs = pair_samples(a, b)
    observed = ScannerObservations(a, view_a), ScannerObservations(b, view_b)
    return miss_detections(T_a_b, *observed, pairs, len(pairs), 0.0)


def still(background: Array, watched: Array | None = None) -> ScannerTracks:
    return ScannerTracks((), background, 0.01, watched)


def circle(radius: float, ticks: int = 100) -> Array:
    angle = np.linspace(0, 2 * np.pi, ticks)
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize(("distance", "past"), [(0.5, True), (4.0, True), (4.8, False), (9.0, False)])
def test_space_before_a_wall_is_free(distance: float, past: bool) -> None:
    assert is_free_space(wall(5.0), distance * circle(1.0), 0.3).all() == past
    assert is_free_space(wall(5.0), distance * circle(1.0), 0.3).any() == past


def test_space_without_returns_is_not_free() -> None:
    half = wall(5.0)[:270]  # below the x axis
    assert is_free_space(half, np.array([[0.0, -3.0], [0.0, 3.0]]), 0.3).tolist() == [True, False]
    assert not is_free_space(np.zeros((0, 2)), circle(1.0), 0.3).any()
    assert not is_free_space(np.full((4, 2), np.nan), circle(1.0), 0.3).any()


def test_space_at_a_depth_edge_is_free_up_to_the_nearer_side() -> None:
    edge = np.array([[3.0, -0.01], [8.0, 0.01]])
    assert is_free_space(edge, np.array([[2.0, 0.0], [5.0, 0.0]]), 0.3).tolist() == [True, False]


def test_the_map_reaches_to_the_usual_detection_range() -> None:
    view = build_visibility_map(still(wall(9.0)), walks(circle(4.0)))
    assert view.covers(circle(3.7)).all()
    assert not view.covers(circle(5.0)).any()


def test_cells_with_detections_are_visible_without_a_background() -> None:
    view = build_visibility_map(still(np.zeros((0, 2))), walks(circle(4.0, ticks=300)))
    assert view.covers(circle(4.0, ticks=300)).mean() > 0.95
    assert not view.covers(circle(3.0)).any()


def test_nothing_is_visible_without_detections() -> None:
    view = build_visibility_map(still(wall(9.0)), NO_SAMPLES)
    assert not view.covers(np.concatenate([circle(r) for r in (0.0, 0.1, 1.0, 1e6)])).any()


def test_a_scanner_without_detections_or_coverage_measured_at_no_time() -> None:
    view = build_visibility_map(still(wall(9.0)), NO_SAMPLES)
    assert view.coverage_intervals.shape == (0, 2)
    assert not view.measures_at(np.array([0.0, 1.0])).any()


def test_positions_outside_the_map_are_not_visible() -> None:
    view = VisibilityMap(np.pad(np.ones((20, 20), dtype=np.bool_), 1), np.zeros((0, 2)))
    assert view.covers(np.array([[0.0, 0.0], [1.9, -1.9]])).all()
    assert not view.covers(np.array([[2.1, 0.0], [-1e9, 0.0], [0.0, 1e9]])).any()


def test_a_pose_with_missed_detections_is_refuted() -> None:
    # b stands 2 m to the right of a; both see the same walk, about b, and halls around them.
    T_a_b = se2.pose(0.0, np.array([2.0, 0.0]))
    b = walks(circle(3.0))
    a = walks(se2.apply(T_a_b, b.positions))
    views = build_visibility_map(still(wall(12.0)), a), build_visibility_map(still(wall(12.0)), b)
    wrong = se2.pose(np.pi, np.array([2.0, 0.0]))  # the other half of the circle at every time
    found = refute(np.array([T_a_b, wrong]), a, b, *views)
    assert found.tolist() == [False, True]


def test_poses_without_overlap_are_not_refuted() -> None:
    a, b = walks(circle(3.0)), walks(circle(3.0))
    views = build_visibility_map(still(wall(4.0)), a), build_visibility_map(still(wall(4.0)), b)
    far = se2.pose(0.3, np.array([20.0, 0.0]))
    assert refute(far[None], a, b, *views).tolist() == [False]
    assert refute(np.zeros((0, 3, 3)), a, b, *views).shape == (0,)


def test_times_without_measurements_have_no_missed_detections() -> None:
    # b's samples end before a's second half, under the true pose.
    x = circle(3.0, ticks=200)
    a, b = walks(x), walks(x[:60])
    views = build_visibility_map(still(wall(12.0)), a), build_visibility_map(still(wall(12.0)), b)
    assert refute(np.eye(3)[None], a, b, *views).tolist() == [False]


def test_measured_times_without_detections_have_missed_detections() -> None:
    x = np.concatenate([circle(3.0, ticks=60), circle(2.0, ticks=140)])
    a, b = walks(x), walks(x[:60])
    watched = np.array([[0.0, 20.0]])
    views = (
        build_visibility_map(still(wall(12.0), watched), a),
        build_visibility_map(still(wall(12.0), watched), b),
    )
    assert refute(np.eye(3)[None], a, b, *views).tolist() == [True]


@pytest.mark.parametrize(("time", "there"), [(0.9, False), (1.0, True), (2.5, False), (3.5, True), (4.1, False)])
def test_a_scanner_measures_within_its_intervals(time: float, there: bool) -> None:
    view = build_visibility_map(still(wall(9.0), np.array([[1.0, 2.0], [3.0, 4.0]])), NO_SAMPLES)
    assert view.measures_at(np.array([time])).tolist() == [there]


@pytest.mark.parametrize(("offset", "expected"), [
    ([0.38, 0.0], True), ([0.43, 0.0], False), ([-0.6, 0.0], False), ([0.0, -0.6], False), ([-0.27, 0.27], True),
])  # fmt: skip
def test_detections_within_the_radius_are_of_the_same_object(offset: list[float], expected: bool) -> None:
    x = circle(3.0)
    a, b = walks(x), walks(x + np.array(offset))
    views = build_visibility_map(still(wall(12.0)), a), build_visibility_map(still(wall(12.0)), b)
    required, detected = find_missed_detections(np.eye(3)[None], pair_samples(a, b), *views, 0.4)
    assert required.shape == detected.shape == (1, 200)
    assert required.mean() > 0.75  # but for samples beyond the usual range of the other scanner
    assert (detected == expected).all()


@pytest.mark.parametrize(("share", "refuted"), [(0.45, False), (0.55, True)])
def test_a_pose_is_refuted_by_the_share_of_missed_detections(
    share: float, refuted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    # b misses the last part of a's samples; those that b has are all detected by a.
    x = circle(3.0, ticks=200)
    a, b = walks(x), walks(x[: round(200 * (1 - share))])
    always = np.array([[0.0, 20.0]])
    views = build_visibility_map(still(wall(12.0), always), a), build_visibility_map(still(wall(12.0), always), a)
    expected, detected = find_missed_detections(np.eye(3)[None], pair_samples(a, b), *views, 0.5)
    missed = np.count_nonzero(expected & ~detected) / np.count_nonzero(expected)
    monkeypatch.setattr(visibility_map, "MAX_MISSED_SHARE", missed * (0.99 if refuted else 1.01))
    found = refute(np.eye(3)[None], a, b, *views)
    assert missed == pytest.approx(share / (2 - share), abs=0.03)
    assert found.tolist() == [refuted]


@pytest.mark.parametrize(("distance", "visible"), [(0.2, False), (0.7, True), (4.3, True), (4.7, False)])
def test_the_map_ends_before_the_background_and_near_the_scanner(distance: float, visible: bool) -> None:
    # Free space before a wall at 5 m, but for 0.5 m, from 0.4 m on.
    view = build_visibility_map(still(wall(5.0)), walks(circle(8.0)))
    assert (view.covers(circle(distance)) == visible).all()


@pytest.mark.parametrize(("count", "visible"), [(2, False), (3, True)])
def test_cells_need_several_detections(count: int, visible: bool) -> None:
    x = np.concatenate([np.tile([[3.0, 0.1]], (count, 1)), circle(6.0)])
    view = build_visibility_map(still(np.zeros((0, 2))), walks(x))
    assert view.covers(np.array([[3.0, 0.1]])).tolist() == [visible]


@pytest.mark.parametrize("missing", [0, 1])
def test_a_pose_is_tested_from_the_least_number_of_expected_detections_on(
    missing: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Under the wrong pose, all expected detections are missed.
    a, b = walks(circle(3.0)), walks(-circle(3.0))
    views = build_visibility_map(still(wall(12.0)), a), build_visibility_map(still(wall(12.0)), b)
    pairs = pair_samples(a, b)
    expected = int(find_missed_detections(np.eye(3)[None], pairs, *views, 0.5)[0].sum())
    assert expected > 100
    monkeypatch.setattr(visibility_map, "_MIN_EXPECTED", expected + missing)
    found = refute(np.eye(3)[None], a, b, *views)
    assert found.tolist() == [missing == 0]
