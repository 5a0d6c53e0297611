"""Changes of poses and clocks during a drive: found, named and measured, and not found where there are none."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from calgraph.drive.adjustment import AdjustmentPriors, adjust_drive
from calgraph.drive.measurements import DrivePart
from calgraph.geometry import Array, se2, se_n
from calgraph.solver.change_tests import PeriodEquations
from calgraph.surfaces.sensor_states import BESIDE_POSE, SensorPoints, SensorState
from calgraph.surfaces.trajectory import Track, fit_spline
from calgraph.verdict.state_changes import Change, describe_changes, find_changes
from drive_scenes import beams_in_plane, drive, scan

SENSORS, PERIODS, STATES = 3, 10, 3 + BESIDE_POSE
T_ROOT_SENSOR = [
    se2.pose(0.0, np.zeros(2)),
    se2.pose(2.0, np.array([-0.5, 0.2])),
    se2.pose(-1.0, np.array([0.4, 0])),
]
PLACES: Array = np.array([T[:2, 2] for T in T_ROOT_SENSOR])
ENDS: Array = 3.0 * np.arange(1.0, PERIODS + 1)


def find(change: Array, seed: int = 0, ends: Array = ENDS) -> list[Change]:
    """Of states that are measured once a period, with a change (S, K, F) in their standard deviations of 1 mm."""
    measured = change + np.random.default_rng(seed).normal(size=change.shape)
    measured -= measured.mean(axis=1, keepdims=True)
    S, K, F = change.shape
    free: NDArray[np.bool_] = np.ones((S, F), dtype=bool)
    free[0] = False
    count = int(free.sum())
    _, period, _ = np.nonzero(np.repeat(free[:, None], K, axis=1))
    same = np.kron(np.eye(S - 1), np.kron(np.ones((K, 1)), np.eye(F)))
    equations = PeriodEquations(
        1e6 * np.eye(len(period)), -1e3 * measured[1:].ravel(), period, same, np.ones(count), np.zeros(count)
    )
    return find_changes(equations, free, ends, PLACES[:S])


def changed(sensor: int, column: int, function: Array) -> Array:
    change = np.zeros((SENSORS, PERIODS, STATES))
    change[sensor, :, column] = function
    return change


def test_noise_alone_is_no_change() -> None:
    """None of 200: the limit leaves room for errors of neighbours that are correlated."""
    assert sum(bool(find(np.zeros((SENSORS, PERIODS, STATES)), seed)) for seed in range(200)) == 0


def test_a_sensor_that_moves_is_named_with_time_and_size() -> None:
    (found,) = find(changed(2, 0, np.where(ENDS > 12, 20.0, 0.0)))
    assert (found.sensors, found.kind, found.time) == ((2,), "pose", 12.0)
    assert_allclose(found.size, [0.02, 0, 0], atol=0.002)


def test_a_clock_that_drifts_is_named_with_the_drift_in_all() -> None:
    (found,) = find(changed(1, 3, np.linspace(0, 30, PERIODS)))
    assert (found.sensors, found.kind, found.time) == ((1,), "clock", None)
    assert_allclose(found.size, [0.03], atol=0.003)


def test_two_changes_are_found_one_beside_the_other() -> None:
    found = find(changed(2, 0, np.where(ENDS > 12, 20.0, 0.0)) + changed(1, 3, np.where(ENDS > 18, 25.0, 0.0)))
    assert {(one.sensors, one.kind, one.time) for one in found} == {((2,), "pose", 12.0), ((1,), "clock", 18.0)}


def test_a_root_that_moves_is_named_instead_of_all_others() -> None:
    """A turn of the root by 30 mrad moves the others by the opposite turn about its origin."""
    change = np.zeros((SENSORS, PERIODS, STATES))
    for k in (1, 2):
        x, y = se_n.translation(T_ROOT_SENSOR[k])
        change[k, ENDS > 15, :3] = 30 * np.array([y, -x, -1])
    (found,) = find(change)
    assert (found.sensors, found.time) == ((0,), 15.0)
    assert_allclose(found.size, [0, 0, 0.03], atol=0.003)


def test_of_two_sensors_both_are_named() -> None:
    (found,) = find(changed(1, 0, np.where(ENDS > 12, 20.0, 0.0))[:2])
    assert found.sensors == (0, 1)


def test_a_short_drive_is_not_tested() -> None:
    assert find(changed(2, 0, np.where(ENDS > 3, 20.0, 0.0))[:, :3], ends=ENDS[:3]) == []


def simulate(seed: int, bump: Array, clock: float) -> tuple[DrivePart, list[SensorState]]:
    """20 s of two scanners, the second of which is moved, and its clock set, after 12 s."""
    rng = np.random.default_rng(seed)
    T = se2.pose(2.5, np.array([-0.4, 0.1]))
    points = []
    for mounted in (np.eye(3), T):
        parts = []
        for after in (False, True):
            moved = se_n.retract(mounted, bump) if after and mounted is T else mounted
            sweeps = scan(beams_in_plane(6.0), moved, 20.0, 0.01, rng)
            x, times = (np.concatenate([getattr(one, name) for one in sweeps]) for name in ("points", "times"))
            own = (times >= 12) == after
            parts.append((x[own], times[own] + (clock if after and mounted is T else 0.0)))
        x, times = (np.concatenate(both) for both in zip(*parts, strict=True))
        points.append(SensorPoints(x, times))
    times = np.arange(201) / 10
    # Walls are not on edges of cells.
    track = Track(times, se2.pose(0.3, np.array([0.2, 0.1])) @ drive(times, 2))
    return DrivePart(points, fit_spline(track, 0.1, 19.8, 0.25)), [SensorState(np.eye(3)), SensorState(T)]


def solve(seed: int, bump: Array, clock: float) -> list[Change]:
    part, states = simulate(seed, bump, clock)
    errors = 0.02, 0.002, 0.0, 0.0, 0.0
    priors = AdjustmentPriors(np.array([[*[0.0] * 4, *errors], [*[1.0] * 3, 0.5, *errors]]))
    return list(adjust_drive([part], states, priors).changes)


@pytest.mark.parametrize("seed", range(3))
def test_drives_without_changes_have_none(seed: int) -> None:
    assert solve(seed, np.zeros(3), 0.0) == []


def test_a_bump_in_a_drive_is_found() -> None:
    (found,) = solve(0, np.array([0.03, 0.0, 0.01]), 0.0)
    assert (found.kind, found.time) == ("pose", 12.1)
    assert_allclose(found.size, [0.03, 0.0, 0.01], atol=0.008)


def test_a_clock_that_jumps_in_a_drive_is_found() -> None:
    found = solve(0, np.zeros(3), 0.03)
    assert (found[0].kind, found[0].time) == ("clock", 12.1)
    assert found[0].size[0] == pytest.approx(0.03, abs=0.006)


def test_descriptions_state_what_when_and_what_to_do() -> None:
    changes = [
        Change((1,), "pose", 12.0, (0.003, 0.004, 0.01)), Change((2,), "clock", None, (-0.02,)),
        Change((0, 2), "clock", 15.0, (0.02,)),
    ]  # fmt: skip
    moved, drifts, jumped = describe_changes(changes, ["front", "rear", "left"], "front", 2.0)
    assert moved.text.startswith("rear moved by 5.0 mm and 0.57° 10 s from the start: fix it firmly")
    assert drifts.text.startswith(
        "the clock of left drifts by 20.0 ms in the course of the recording: synchronize"
    )
    assert jumped.text.startswith("the clock of front or left jumped by 20.0 ms 13 s from the start")
    assert (moved.sensors, drifts.sensors) == (("rear",), ("left",))
    assert jumped.sensors == ("front", "rear", "left")


def test_all_poses_are_weak_where_the_published_root_moved() -> None:
    (found,) = describe_changes([Change((1,), "pose", 12.0, (0.1, 0, 0))], ["front", "rear", "left"], "rear", 0.0)
    assert found.sensors == ("front", "rear", "left")
