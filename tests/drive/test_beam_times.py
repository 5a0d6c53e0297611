"""Scans that state no times of beams: what the joint solution finds of them, over what it finds without."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.drive.adjustment import Adjustment, AdjustmentPriors, adjust_drive
from calgraph.drive.assemble import describe_sensor_errors
from calgraph.drive.measurements import DrivePart
from calgraph.drive.sweeps import Sweep, smooth_times
from calgraph.geometry import Array, se_n
from calgraph.surfaces.sensor_states import TIMING, SensorPoints, SensorState
from calgraph.surfaces.trajectory import Track, fit_spline
from drive_scenes import PERIOD, beams_in_plane, drive, scan

DURATION = 20.0
SWEEP, ODD = 0.012, 0.03
"""True times from the first to the last beam, and of odd beams, s."""
CLOCK = 0.2
MOUNTED = se_n.pose(se_n.exp(np.array([2.8])), np.array([-0.5, 0.1]))
FREE = (0.5, 0.5, 1.0)


def measure(T: Array, clock: float, rounded: float, rng: np.random.Generator) -> list[Sweep]:
    """Interlaced scans without times; stamps are those of the first beams, by a clock, rounded down."""
    directions, _ = beams_in_plane(3.0)
    beam = np.arange(len(directions))
    share, odd = beam / (len(beam) - 1), beam % 2
    stamps, sweeps = [], []
    for one in scan((directions, SWEEP * share + ODD * odd), T, DURATION, 0.005, rng):
        stamp = np.floor((one.times[0] + clock) / rounded) * rounded
        stamps.append(stamp)
        timing = np.column_stack([share, odd, np.zeros(len(beam))])
        sweeps.append(Sweep(stamp, one.points, np.full(len(beam), stamp), timing))
    return smooth_times(sweeps, np.array(stamps))


def solve(seed: int, timing: Sequence[float]) -> Adjustment:
    rng = np.random.default_rng(seed)
    points = []
    for T, clock in ((np.eye(3), 0.0), (MOUNTED, CLOCK)):
        sweeps = measure(T, clock, 0.013, rng)
        names = ("points", "times", "timing")
        x, at, shares = (np.concatenate([getattr(one, name) for one in sweeps]) for name in names)
        points.append(SensorPoints(x, at, shares))
    times = np.arange(-2, 10 * DURATION + 3) / 10
    world = se_n.pose(se_n.exp(np.array([0.3])), np.full(2, 0.13))
    track = Track(times, world @ drive(np.maximum(times, 0), 2))
    part = DrivePart(points, fit_spline(track, 0.2, DURATION - 0.4, 0.1))
    states = [SensorState(np.eye(3)), SensorState(se_n.retract(MOUNTED, np.array([0.02, -0.03, 0.01])), CLOCK)]
    errors = 0.01, 0.001, *timing
    return adjust_drive(
        [part], states, AdjustmentPriors(np.array([[*[0.0] * 4, *errors], [*[1.0] * 3, 0.1, *errors]]))
    )


@pytest.fixture(scope="module")
def found() -> Adjustment:
    return solve(0, FREE)


def test_times_of_beams_are_found(found: Adjustment) -> None:
    for state in found.states:
        assert state.timing[1] * PERIOD == pytest.approx(ODD, abs=1e-3)
        assert state.timing[0] * PERIOD == pytest.approx(SWEEP, abs=3e-3)


def test_errors_of_ranges_and_times_are_stated_with_their_units(found: Adjustment) -> None:
    sensors = {name: {"kind": "lidar2d", "topic": f"/{name}"} for name in "ab"}
    rig = Rig.model_validate({"root": "a", "target": {"kind": "surroundings"}, "sensors": sensors})
    errors = {(one.of, one.quantity): one for one in describe_sensor_errors(rig, ["a", "b"], found)}
    for name in "ab":
        sweep, odd = errors[name, "time from first to last beam"], errors[name, "delay of odd beams"]
        assert (sweep.unit, odd.unit) == ("s", "s")
        assert sweep.value == pytest.approx(SWEEP, abs=4 * sweep.stddev)
        assert odd.value == pytest.approx(ODD, abs=4 * odd.stddev)
        assert odd.prior == pytest.approx(PERIOD / 2, rel=0.01)
        assert 1e-5 < odd.stddev < 0.002
        bias, scale = errors[name, "range bias"], errors[name, "range scale"]
        assert abs(bias.value) < 4 * bias.stddev < 0.05
        assert scale.value == pytest.approx(1, abs=4 * scale.stddev)
    assert len(errors) == 8


def test_times_that_clouds_state_have_no_errors() -> None:
    points = SensorPoints(np.ones((5, 2)), np.zeros(5))
    part = SimpleNamespace(points=[points, points])
    adjusted = cast(Adjustment, SimpleNamespace(
        states=[SensorState(np.eye(3), range_scale=0.01), SensorState(np.eye(3))], parts=[part],
        stddev=np.ones((2, 9)), point_counts=np.array([5, 0]),
    ))  # fmt: skip
    sensors = {name: {"kind": "lidar2d", "topic": f"/{name}"} for name in "ab"}
    rig = Rig.model_validate({"root": "a", "target": {"kind": "surroundings"}, "sensors": sensors})
    bias, scale = describe_sensor_errors(rig, ["a", "b"], adjusted)
    assert (bias.of, bias.quantity, scale.quantity) == ("a", "range bias", "range scale")
    # Points are multiplied by 1 - 0.01.
    assert scale.value == pytest.approx(1 / 0.99)


def test_poses_are_better_than_without(found: Adjustment) -> None:
    errors = [se_n.difference(one.states[1].T_root_sensor, MOUNTED) for one in (found, solve(0, (0.0,) * TIMING))]
    place, turn = np.array([[np.linalg.norm(e[:2]), abs(e[2])] for e in errors]).T
    assert place[0] < 0.5 * place[1]
    assert turn[0] < turn[1]
