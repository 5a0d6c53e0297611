"""Simulated detections whose matches are all believed: what joint estimators start from, without search."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from calgraph.captures import CaptureSet
from calgraph.config import Rig
from calgraph.detection import Detection
from calgraph.estimation import Estimable, RigSolution, solve_bundle
from calgraph.geometry import Array, se3
from calgraph.pairwise import PairwiseEstimate
from calgraph.simulation import (
    CameraKnobs,
    LaserKnobs,
    MultibeamKnobs,
    RigScenario,
    SpinningKnobs,
    Stage,
    Truth,
    set_stage,
    simulate_detections,
)

QUICK = RigScenario(
    camera=CameraKnobs(width=640, height=480, texels_per_mm=0.5, distortion=(-0.2, 0.05, 0.001, -0.001)),
    laser=LaserKnobs(count=1, resolution=1.0),
    spinning=SpinningKnobs(count=0),
    multibeam=MultibeamKnobs(count=1, resolution=2.0),
    bearings=(-30, -20, -10, 0, 10, 20, 30),
    radii=(1.5, 2.2, 3.0),
    background=1.0,
)


@dataclass(frozen=True, eq=False)
class Seen:
    rig: Rig
    captured: CaptureSet
    T_root_sensor: dict[str, Array]
    """True poses, the root first."""
    truth: Truth

    def changed(self, change: Callable[[str, Detection], Detection]) -> "Seen":
        detections = {
            name: {capture: tuple(change(name, d) for d in found) for capture, found in by.items()}
            for name, by in self.captured.detections.items()
        }
        return replace(self, captured=replace(self.captured, detections=detections))

    def solved(self, *estimate: Estimable) -> RigSolution:
        """From the true poses, and with matches all of which are believed."""
        return solve_bundle(self.rig, self.captured, self.agreeing(), self.T_root_sensor, estimate=estimate)

    def agreeing(self) -> Sequence[PairwiseEstimate]:
        return [self._pair(a, b) for a, b in combinations(self.T_root_sensor, 2)]

    def _pair(self, a: str, b: str) -> PairwiseEstimate:
        common = sorted(set(self.captured.detections[a]) & set(self.captured.detections[b]))
        matches = np.array([(capture, 0, 0) for capture in common], dtype=np.intp).reshape(-1, 3)
        T_a_b = se3.inverse(self.T_root_sensor[a]) @ self.T_root_sensor[b]
        believed, residuals = np.ones(len(common), dtype=bool), np.zeros(len(common))
        return PairwiseEstimate(a, b, T_a_b, np.eye(6), matches, believed, residuals)

    def mahalanobis(self, joint: RigSolution, name: str) -> float:
        """Squared distance of a sensor's pose from the truth, over its degrees of freedom."""
        error = se3.difference(joint.T_root_sensor[name], self.T_root_sensor[name])
        return float(error @ np.linalg.solve(joint.covariance[name], error)) / 6

    def error(self, joint: RigSolution, name: str) -> float:
        """m."""
        return float(np.linalg.norm((joint.T_root_sensor[name] - self.T_root_sensor[name])[:3, 3]))


def seen(scenario: RigScenario = QUICK, seed: int = 0) -> Seen:
    return seen_on(set_stage(scenario, 1), seed)


def seen_on(stage: Stage, seed: int) -> Seen:
    """One of many recordings of the same boards."""
    rig, captured, truth = simulate_detections(stage, seed)
    others = {name: T for name, T in truth.T_root_sensor.items() if name != rig.root}
    return Seen(rig, captured, {rig.root: np.eye(4), **others}, truth)
