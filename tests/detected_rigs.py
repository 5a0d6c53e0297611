"""Simulated detections with all matches as inliers: the input of joint estimators, without a search for pairs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from calgraph.boards.detections import Detection
from calgraph.config import Board, Rig, SensorSpec
from calgraph.geometry import Array, se3
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.rig.bundle.estimate import solve_bundle
from calgraph.rig.bundle.solution import RigSolution
from calgraph.rig.captures.detect import CaptureSet
from calgraph.simulation import (
    CameraOptions,
    GroundTruth,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    World,
    build_world,
)
from ideal_detections import IdealDetectorOptions, simulate_detections
from rig_errors import ModelErrors

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

    def without_systematic_errors(self) -> "DetectedRig":
        """The same, with sensors and boards exactly as stated: nothing is estimated besides poses and noise."""
        return replace(self, rig=exact_rig(self.rig))

    def solve(self) -> RigSolution:
        """The joint solution from the true poses, with all matches as inliers."""
        return solve_bundle(self.rig, self.captures, self.pairs(), self.T_root_sensor)

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


def exact_rig(rig: Rig) -> Rig:
    """The rig with prior standard deviations of 0 for all systematic errors."""
    sensors = {name: spec.model_copy(update=_exact(spec)) for name, spec in rig.sensors.items()}
    boards = tuple(board.model_copy(update=_exact(board)) for board in rig.boards)
    return rig.model_copy(update={"sensors": sensors, "target": boards if len(boards) > 1 else boards[0]})


def with_uncertainty(rig: Rig, part: str, **stddev: float) -> Rig:
    """The rig with prior standard deviations of a sensor, or of the ``board``."""

    def change(spec: SensorSpec | Board) -> dict[str, object]:
        return {"uncertainty": spec.uncertainty.model_copy(update=stddev)}

    if part == "board":
        (board,) = rig.boards
        return rig.model_copy(update={"target": board.model_copy(update=change(board))})
    spec = rig.sensors[part]
    return rig.model_copy(update={"sensors": {**rig.sensors, part: spec.model_copy(update=change(spec))}})


def _exact(part: SensorSpec | Board) -> dict[str, object]:
    return {
        "uncertainty": part.uncertainty.model_copy(update=dict.fromkeys(type(part.uncertainty).model_fields, 0.0))
    }


def detect_rig(scenario: RigScenario = QUICK, seed: int = 0, errors: ModelErrors | None = None) -> DetectedRig:
    return detect_rig_on(build_world(scenario, 1, images=False), seed, errors)


def detect_rig_on(
    stage: World, seed: int, errors: ModelErrors | None = None, options: IdealDetectorOptions | None = None
) -> DetectedRig:
    """One of many recordings of the same boards."""
    rig, captured, truth = simulate_detections(stage, seed, options, errors)
    others = {name: T for name, T in truth.T_root_sensor.items() if name != rig.root}
    return DetectedRig(rig, captured, {rig.root: np.eye(4), **others}, truth)
