"""All tests of a solution together: right rigs pass, also of few captures."""

from dataclasses import replace

import numpy as np
import pytest

from bundle_scenes import scene
from calgraph.result import HeldOutError
from calgraph.rig.bundle.bundle_solver import minimize_bundle
from calgraph.rig.bundle.solution import RigSolution, SolvedBundle
from calgraph.rig.checks.contradictions import find_contradictions
from calgraph.rig.checks.cross_validation import cross_validate
from detected_rigs import DetectedRig, detect_rig

pytestmark = pytest.mark.slow


def first_captures(detected: DetectedRig, count: int) -> DetectedRig:
    by_sensor = {
        name: {k: d for k, d in found.items() if k < count} for name, found in detected.captures.detections.items()
    }
    captures = replace(detected.captures, holds=detected.captures.holds[:count], detections=by_sensor)
    return replace(detected, captures=captures)


@pytest.mark.parametrize("captures", [8, 14, 100])
@pytest.mark.parametrize("seed", range(2))
def test_nothing_contradicts_right_rigs(captures: int, seed: int) -> None:
    detected = first_captures(detect_rig(seed=seed), captures)
    joint = detected.solve()
    assert joint.solved_bundle is not None
    held_out = cross_validate(joint.solved_bundle, 4)
    assert find_contradictions(joint, detected.rig, detected.captures, held_out) == ()


def test_other_estimators_are_not_tested() -> None:
    detected = detect_rig()
    joint = RigSolution("hypergraph", detected.T_root_sensor, np.zeros((18, 18)), {}, converged=True)
    assert find_contradictions(joint, detected.rig, detected.captures, {}) == ()


@pytest.mark.parametrize(("views", "ratio", "found"), [(20, 1.2, 0), (3, 4.0, 0), (20, 3.0, 1)])
def test_poor_predictions_of_held_out_captures_are_named(views: int, ratio: float, found: int) -> None:
    detected = detect_rig()
    held_out = {"camera": HeldOutError(views, "px", 1.0, 1.0, ratio)}
    findings = find_contradictions(detected.solve(), detected.rig, detected.captures, held_out)
    assert [one.sensors for one in findings] == [("camera",)] * found


def test_few_captures_with_errors_beyond_their_covariance_are_named() -> None:
    detected, exact = detect_rig(), scene(("lidar", "camera", "laser_front"), boards=10)
    bundle = exact.measured(np.random.default_rng(0), view_bias=0.02)
    solved = SolvedBundle(bundle, minimize_bundle(bundle, exact.truth), np.arange(10))
    poses = dict(zip(bundle.sensors, solved.minimized.state.T_root_sensor, strict=True))
    joint = RigSolution("bundle", poses, np.zeros((18, 18)), {}, converged=True, solved_bundle=solved)
    found = find_contradictions(joint, detected.rig, detected.captures, {})
    resampled = [one.sensors for one in found if "resampled" in one.text]
    assert resampled
    assert set(resampled) <= {("camera",), ("laser_front",)}
