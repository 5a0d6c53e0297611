"""Scans without times of beams of a board that moves: whether the scanner turns is found, and corrected."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

import moving_boards as simulated
from calgraph.boards.detections import Segment
from calgraph.config import Rig
from calgraph.rig.beam_times import UntimedScanner, compensate_with_beam_times
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.captures.moving_board import compensate_motion
from calgraph.simulation import CameraOptions, LaserOptions, RigScenario, SpinningOptions, build_world
from ideal_detections import as_scanner
from moving_boards import MovingBoardOptions, simulate_moving_detections

LASER = "laser_front"


def simulate(
    monkeypatch: pytest.MonkeyPatch, seed: int, turn: int, rate: float, captures: int = 60, speed: float = 0.4
) -> tuple[Rig, CaptureSet, CaptureSet, UntimedScanner]:
    """A camera and a 2-D scanner that turns forwards (1), backwards (-1) or not (0): with times, and without."""
    scenario = RigScenario(
        camera=CameraOptions(),
        laser=LaserOptions(count=1, rate=rate, mirror_rate=rate),
        spinning=SpinningOptions(count=0),
        bearings=(-35, -25, -15, -5, 5, 15, 25, 35),
    )
    world = build_world(scenario, seed)
    pattern = as_scanner(next(one for one in world.robot if one.name == LASER)).pattern
    times = {1: pattern.times, -1: pattern.times[::-1].copy(), 0: np.zeros_like(pattern.times)}[turn]
    with monkeypatch.context() as patch:
        timed_pattern = replace(pattern, times=times)
        patch.setattr(simulated, "as_scanner", lambda sensor: replace(as_scanner(sensor), pattern=timed_pattern))
        patch.setattr(simulated, "compensate_motion", lambda found, _: found)
        motion = MovingBoardOptions(speed=speed, captures=captures)
        rig, timed, _ = simulate_moving_detections(world, seed, motion)
    segments = {
        capture: tuple(replace(one, times=np.zeros(0)) for one in found if isinstance(one, Segment))
        for capture, found in timed.detections[LASER].items()
    }
    angles = np.unwrap(np.arctan2(pattern.directions[:, 1], pattern.directions[:, 0]))
    untimed = replace(timed, detections={**timed.detections, LASER: segments})
    return rig, timed, untimed, UntimedScanner(angles, 1 / rate)


def list_ranges(captures: CaptureSet) -> Iterator[np.ndarray]:
    for found in captures.detections[LASER].values():
        yield from (one.ranges for one in found if isinstance(one, Segment))


@pytest.mark.parametrize(("seed", "turn"), [(0, 1), (1, -1)])
def test_a_scanner_that_turns_is_named_and_its_beams_get_their_times(
    monkeypatch: pytest.MonkeyPatch, seed: int, turn: int
) -> None:
    rig, timed, untimed, scanner = simulate(monkeypatch, seed, turn, rate=15)
    found = compensate_with_beam_times(rig, untimed, {LASER: scanner}, np.random.default_rng(0))
    [finding] = found.findings
    assert finding.text.startswith(f"the scans of {LASER} have no times of beams (time_increment is 0), but the ")
    assert "turn in 67 ms" in finding.text
    assert finding.sensors == ()
    settings = rig.settings.captures.moving_board
    right, uncorrected = (compensate_motion(one, settings) for one in (timed, untimed))
    errors = {
        name: np.concatenate([a - b for a, b in zip(list_ranges(one), list_ranges(right), strict=True)])
        for name, one in {"corrected": found, "uncorrected": uncorrected}.items()
    }
    rms = {name: float(np.sqrt(np.mean(one**2))) for name, one in errors.items()}
    assert rms["uncorrected"] > 0.003
    assert rms["corrected"] < 0.05 * rms["uncorrected"]


@pytest.mark.parametrize(("rate", "seed"), [(15.0, 1), (40.0, 1)])
def test_simultaneous_beams_get_no_times(monkeypatch: pytest.MonkeyPatch, rate: float, seed: int) -> None:
    rig, _, untimed, scanner = simulate(monkeypatch, seed, 0, rate)
    found = compensate_with_beam_times(rig, untimed, {LASER: scanner}, np.random.default_rng(0))
    assert found.findings == ()
    right = compensate_motion(untimed, rig.settings.captures.moving_board)
    assert all(np.array_equal(a, b) for a, b in zip(list_ranges(found), list_ranges(right), strict=True))


def test_where_few_captures_do_not_show_it_the_scanner_is_weak(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, _, untimed, scanner = simulate(monkeypatch, 0, 1, rate=5, captures=8, speed=0.3)
    found = compensate_with_beam_times(rig, untimed, {LASER: scanner}, np.random.default_rng(0))
    [finding] = found.findings
    assert "the captures do not show whether all are simultaneous" in finding.text
    assert finding.sensors == (LASER,)
