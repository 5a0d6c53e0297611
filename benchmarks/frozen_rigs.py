"""The problems of frozen.py with a board: the rigs of model_errors.py."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial

import numpy as np

from calgraph.config import Rig
from calgraph.result import Calibration
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from model_error_kinds import KINDS, cases
from model_error_rigs import SCENARIOS
from model_errors import DRAWN, DRAWN_CAPTURES, RIGHT, SMALL_TREMORS, TREMOR, detect

Make = Callable[[], object]
WITHOUT: Mapping[str, tuple[str, ...]] = {
    "range_bias": ("cameras",), "range_scale": ("cameras",), "footprint": ("cameras",),
    "angle_scale": ("pair", "cameras"), "ring_bias": ("five", "cameras"), "ring_elevation": ("five", "cameras"),
}  # fmt: skip
"""Rigs without a sensor that could be wrong so."""
RIGS_PER_CASE = 2


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
        tremor = SMALL_TREMORS[k % len(SMALL_TREMORS)]
        yield f"model_errors/{rig}/sharp_tremor/{tremor:.6g}/0", partial(_detected, rig, TREMOR, tremor, 0)
