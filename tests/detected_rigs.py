"""Simulated detections with all matches as inliers: the input of joint estimators, without a search for pairs."""

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
    CameraOptions,
    GroundTruth,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    World,
    build_world,
    simulate_detections,
)

QUICK = RigScenario(
    camera=CameraOptions(width=640, height=480, texels_per_mm=0.5, distortion=(-0.2, 0.05, 0.001, -0.001)),
    laser=LaserOptions(count=1, resolution=1.0),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=1, resolution=2.0),
    bearings=(-30, -20, -10, 0, 10, 20, 30),
    radii=(1.5, 2.2, 3.0),
    background=1.0,
)


@dataclass(frozen=True, eq=False)
class DetectedRig:
    rig: Rig
    captures: CaptureSet
    T_root_sensor: dict[str, Array]
    """True poses, the root first."""
    truth: GroundTruth

    def map_detections(self, change: Callable[[str, Detection], Detection]) -> "DetectedRig":
        detections = {
            name: {capture: tuple(change(name, d) for d in found) for capture, found in by.items()}
            for name, by in self.captures.detections.items()
        }
        return replace(self, captures=replace(self.captures, detections=detections))

    def solve(self, *estimate: Estimable) -> RigSolution:
        """The joint solution from the true poses, with all matches as inliers."""
        return solve_bundle(self.rig, self.captures, self.pairs(), self.T_root_sensor, estimate=estimate)

    def pairs(self) -> Sequence[PairwiseEstimate]:
        return [self._make_pair(a, b) for a, b in combinations(self.T_root_sensor, 2)]

    def _make_pair(self, a: str, b: str) -> PairwiseEstimate:
        common = sorted(set(self.captures.detections[a]) & set(self.captures.detections[b]))
        matches = np.array([(capture, 0, 0) for capture in common], dtype=np.intp).reshape(-1, 3)
        T_a_b = se3.inverse(self.T_root_sensor[a]) @ self.T_root_sensor[b]
        inliers, residuals = np.ones(len(common), dtype=bool), np.zeros(len(common))
        return PairwiseEstimate(a, b, T_a_b, np.eye(6), matches, inliers, residuals)

    def mahalanobis(self, joint: RigSolution, name: str) -> float:
        """Squared distance of a sensor's pose from the truth, over its degrees of freedom."""
        error = se3.difference(joint.T_root_sensor[name], self.T_root_sensor[name])
        return float(error @ np.linalg.solve(joint.covariance[name], error)) / 6

    def error(self, joint: RigSolution, name: str) -> float:
        """m."""
        return float(np.linalg.norm((joint.T_root_sensor[name] - self.T_root_sensor[name])[:3, 3]))


def detect_rig(scenario: RigScenario = QUICK, seed: int = 0) -> DetectedRig:
    return detect_rig_on(build_world(scenario, 1), seed)


def detect_rig_on(stage: World, seed: int) -> DetectedRig:
    """One of many recordings of the same boards."""
    rig, captured, truth = simulate_detections(stage, seed)
    others = {name: T for name, T in truth.T_root_sensor.items() if name != rig.root}
    return DetectedRig(rig, captured, {rig.root: np.eye(4), **others}, truth)
