"""Scanners that were bumped, that stood still, and that never did."""

from collections.abc import Callable

import numpy as np
import pytest

from calgraph.config.settings import StationaritySettings
from calgraph.geometry import Array, se2
from calgraph.network.tracking.scan_stack import stack_scans
from calgraph.network.tracking.stationarity import (
    _SETTLING_TIME,
    MIN_REST_SHARE,
    Stationarity,
    analyze_stationarity,
    select_interval,
)
from calgraph.sensors import LaserScan
from calgraph.simulation.network_floor import polygon_sides, rectangle
from static_rooms import CORRIDOR, FURNITURE, ROOM, Motion, scan_room, step

SETTINGS = StationaritySettings()
SECONDS = 30.0
AT_REST = Stationarity(tested=True)


def analyze(scans: list[LaserScan]) -> Stationarity:
    return analyze_stationarity(stack_scans(scans), SETTINGS)


def test_a_scanner_at_rest_has_no_bump() -> None:
    assert analyze(scan_room(SECONDS)) == AT_REST


@pytest.mark.parametrize("at", [4.3, 15.0, 26.1])
def test_a_bump_is_located_to_a_second(at: float) -> None:
    (bump,) = analyze(scan_room(SECONDS, step(at, degrees=1.0))).bumps
    assert np.mean(bump.interval) == pytest.approx(at, abs=0.5)


@pytest.mark.parametrize(
    ("x", "y", "degrees"), [(0, 0, 1), (0, 0, -3), (0.03, 0, 0), (0, 0.03, 0), (0.1, 0.05, 10), (0.2, 0.2, -70)]
)
def test_the_size_of_a_bump_is_measured(x: float, y: float, degrees: float) -> None:
    (bump,) = analyze(scan_room(SECONDS, step(12.0, x, y, degrees))).bumps
    assert bump.translation == pytest.approx(np.hypot(x, y), abs=4 * bump.translation_stddev)
    assert bump.rotation == pytest.approx(np.radians(degrees), abs=4 * bump.rotation_stddev)
    assert max(bump.translation_stddev, bump.rotation_stddev) < 0.003


def test_two_bumps_are_found() -> None:
    def motion(time: float) -> Array:
        return se2.pose(0.0, np.array([0.0, 0.04 * ((time > 10) + (time > 20))]))

    bumps = analyze(scan_room(SECONDS, motion)).bumps
    assert [np.mean(bump.interval) for bump in bumps] == pytest.approx([10, 20], abs=0.5)


def test_a_bump_to_a_place_without_common_background_has_no_size() -> None:
    turns = np.linspace(0, 2 * np.pi, 25)[:-1]
    radius = np.tile([2.5, 7.0], 12)
    star = polygon_sides(radius[:, None] * np.column_stack([np.cos(turns), np.sin(turns)]) + [100.0, 0.0])
    carried = se2.pose(0.0, np.array([100.0, 0.0]))

    def motion(time: float) -> Array:
        return carried if time > 15 else np.eye(3)

    (bump,) = analyze(scan_room(SECONDS, motion, lambda _time: np.concatenate([star, ROOM]))).bumps
    assert np.isnan([bump.translation, bump.rotation]).all()


def furnish(moved: Callable[[float], Array]) -> Callable[[float], Array]:
    return lambda time: np.concatenate([ROOM, FURNITURE + moved(time)])


@pytest.mark.parametrize("distance", [0.01, 0.03, 0.1, 0.5])
def test_furniture_that_moves_is_no_bump(distance: float) -> None:
    segments = furnish(lambda time: np.array([distance, 0.0]) * (time > 15))
    assert not analyze(scan_room(SECONDS, segments=segments)).bumps


def test_surroundings_that_change_by_half_are_no_bump() -> None:
    def segments(time: float) -> Array:
        east = np.where(ROOM[..., :1].min(axis=1, keepdims=True) > -1, 0.4 * (time > 15), 0.0)
        return np.concatenate([ROOM + east * [1, 0], FURNITURE + 0.3 * (time > 15)])

    assert not analyze(scan_room(SECONDS, segments=segments)).bumps


def test_a_corridor_does_not_show_motion_along_it() -> None:
    corridor = scan_room(SECONDS, step(15.0, x=0.05), lambda _time: CORRIDOR)
    assert analyze(corridor) == AT_REST


def test_a_corridor_shows_motion_across_it() -> None:
    corridor = scan_room(SECONDS, step(15.0, y=0.05), lambda _time: CORRIDOR)
    assert len(analyze(corridor).bumps) == 1


def test_along_a_single_wall_the_size_of_a_bump_is_not_observable() -> None:
    wall = np.array([[(4.0, -6.0), (4.0, 6.0)]])
    (bump,) = analyze(scan_room(SECONDS, step(15.0, degrees=3.0), lambda _time: wall, max_range=6.0)).bumps
    assert bump.rotation == pytest.approx(np.radians(3.0), abs=0.002)
    assert bump.translation < 0.02
    assert bump.translation_stddev > 0.05


def test_without_background_nothing_is_tested() -> None:
    assert analyze(scan_room(SECONDS, step(15.0, x=1.0), max_range=1.0)) == Stationarity()


def test_a_person_who_hides_half_of_the_view_for_a_while_is_no_bump() -> None:
    person = np.array([[(0.3, -0.5), (0.3, 0.5)]])

    def segments(time: float) -> Array:
        return np.concatenate([ROOM, FURNITURE, *([person] if 10 < time < 18 else [])])

    assert analyze(scan_room(SECONDS, segments=segments)) == AT_REST


def test_a_cover_is_no_bump() -> None:
    cover = polygon_sides(rectangle((0.0, 0.0), (0.4, 0.5)))

    def segments(time: float) -> Array:
        return cover if time < 8 else np.concatenate([ROOM, FURNITURE])

    assert not analyze(scan_room(SECONDS, segments=segments)).bumps


def test_a_disturbance_of_a_second_is_no_bump() -> None:
    def motion(time: float) -> Array:
        return se2.pose(0.1 if 14 < time < 15 else 0.0, np.zeros(2))

    assert not analyze(scan_room(SECONDS, motion)).bumps


@pytest.mark.parametrize(("speed", "turn"), [(0.5, 0.0), (0.1, 0.0), (0.0, 0.3), (0.3, 0.2)])
def test_a_moving_scanner_is_never_at_rest(speed: float, turn: float) -> None:
    def motion(time: float) -> Array:
        sway = np.sin(0.3 * time)
        return se2.pose(turn * sway / 0.3, np.array([speed * sway / 0.3, 0.0]))

    assert analyze(scan_room(SECONDS, motion)).rest_share < MIN_REST_SHARE


def carry(time: float) -> Array:
    return se2.pose(0.3 * time, np.array([0.3 * np.sin(time), 0.3 * np.cos(time)]))


def test_a_scanner_that_is_carried_at_the_start_is_at_rest_afterwards() -> None:
    (bump,) = analyze(scan_room(SECONDS, lambda time: carry(min(time, 6.0)))).bumps
    assert bump.interval[1] == pytest.approx(6.0, abs=1.1)
    assert np.isnan(bump.translation)


def test_a_scanner_that_is_taken_away_is_calibrated_from_before() -> None:
    start, end = interval(lambda time: carry(max(time, 22.0)))
    assert start == 0.0
    assert end == pytest.approx(22.0, abs=1.5)


def test_a_short_recording_at_rest_is_at_rest() -> None:
    assert analyze(scan_room(7.0)) == AT_REST


def test_no_scans_are_not_tested() -> None:
    assert analyze([]) == Stationarity()


def interval(motion: Motion) -> tuple[float, float]:
    runs = stack_scans(scan_room(SECONDS, motion))
    return select_interval((0.0, SECONDS), analyze_stationarity(runs, SETTINGS).bumps, SETTINGS)


def test_without_bumps_all_data_are_used() -> None:
    assert interval(step(99.0)) == (-np.inf, np.inf)


def test_data_after_the_last_bump_are_used() -> None:
    start, end = interval(step(15.0, degrees=3.0))
    assert start == pytest.approx(15.0 + _SETTLING_TIME, abs=0.2)
    assert end == np.inf


def test_the_longest_interval_is_used_if_the_last_one_is_short() -> None:
    start, end = interval(step(25.0, degrees=3.0))
    assert start == 0.0
    assert end == pytest.approx(25.0 - _SETTLING_TIME, abs=0.2)
