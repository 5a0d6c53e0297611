"""The problems of frozen.py with a board: the rigs of model_errors.py."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial

import numpy as np

from calgraph.config import CameraSpec, PixelNoise, Rig
from calgraph.result import Calibration
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from ideal_detections import IdealDetectorOptions, simulate_detections
from model_error_kinds import KINDS, cases
from model_error_rigs import SCENARIOS, rig_world
from model_errors import DRAWN, DRAWN_CAPTURES, RIGHT, detect
from rig_errors import BoardErrors, ModelErrors

Make = Callable[[], object]
WITHOUT: Mapping[str, tuple[str, ...]] = {
    "range_bias": ("cameras",), "range_scale": ("cameras",), "footprint": ("cameras",),
    "angle_scale": ("pair", "cameras"), "ring_bias": ("five", "cameras"), "ring_elevation": ("five", "cameras"),
}  # fmt: skip
"""Rigs without a sensor that could be wrong so."""
RIGS_PER_CASE = 2
TREMORS = 0.0005, 0.001
"""Standard deviation of the board's position from message to message, m."""
SHARP = IdealDetectorOptions(pixel=0.05)
"""Corners of good detectors in sharp images."""


def list_rig_problems() -> Iterator[tuple[str, Make]]:
    """Names and functions of all of them."""
    yield from _wrong_worlds()
    yield from _right_worlds()


def calibrated(rig: Rig, captured: CaptureSet, seed: int, options: RigOptions | None = None) -> Calibration:
    """The result from detections."""
    problem = build_problem_from_captures(rig, captured, options or RigOptions(), np.random.default_rng(seed))
    return solve_problem(problem)


def _wrong_worlds() -> Iterator[tuple[str, Make]]:
    """Every kind and size in some of the rigs, in turn, so that each kind is in all rigs or nearly."""
    for k, (kind, size) in enumerate(cases(tuple(KINDS))):
        rigs = [rig for rig in SCENARIOS if rig not in WITHOUT.get(kind, ())]
        for step in range(min(RIGS_PER_CASE, len(rigs))):
            rig = rigs[(RIGS_PER_CASE * k + step) % len(rigs)]
            yield f"model_errors/{rig}/{kind}/{size:.6g}/0", partial(_detected, rig, kind, size, 0)


def _detected(rig: str, kind: str, size: float, seed: int) -> Calibration:
    detected = detect(rig, kind, size, seed)
    assert detected is not None
    return calibrated(*detected[:2], seed)


def _right_worlds() -> Iterator[tuple[str, Make]]:
    for rig in SCENARIOS:
        for seed in (1, 2):
            yield f"model_errors/{rig}/right/0/{seed}", partial(_detected, rig, RIGHT, 0.0, seed)
    for k, rig in enumerate(SCENARIOS):
        for seed in (0, 1):
            captures = DRAWN_CAPTURES[(k + seed) % len(DRAWN_CAPTURES)]
            yield f"model_errors/{rig}/drawn/{captures}/{seed}", partial(_detected, rig, DRAWN, captures, seed)
        tremor = TREMORS[k % len(TREMORS)]
        yield f"model_errors/{rig}/sharp_tremor/{tremor:.6g}/0", partial(_trembling, rig, tremor, 0)


def _trembling(rig: str, tremor: float, seed: int) -> Calibration:
    """Of a board that trembles, in sharp images."""
    errors = ModelErrors(BoardErrors(tremor=tremor))
    stated, captured, _ = simulate_detections(rig_world(rig, seed), seed, SHARP, errors)
    # Who writes a rig.yaml does not know how sharp the images are.
    sensors = {
        name: spec.model_copy(update={"noise": PixelNoise()}) if isinstance(spec, CameraSpec) else spec
        for name, spec in stated.sensors.items()
    }
    return calibrated(stated.model_copy(update={"sensors": sensors}), captured, seed)
