"""The calibration of a rig from its solution: rows of captures, edges, verdicts, and unconnected sensors."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from calgraph.config import Tolerance
from calgraph.errors import Rejected
from calgraph.geometry import se3
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.graph.spanning_tree import SpanningTree
from calgraph.result import Calibration, CaptureRow, HeldOutError, Verdict
from calgraph.result.finding import Finding
from calgraph.rig.bundle.bundle_parameters import SensorPrior
from calgraph.rig.bundle.bundle_solver import minimize_bundle
from calgraph.rig.bundle.problem import Problem, SolverOptions
from calgraph.rig.bundle.solution import RigSolution
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.checks.assemble import assemble_rig
from detected_rigs import DetectedRig, detect_rig

CAPTURES = 5
RESIDUALS = {("lidar", "camera"): 0.003, ("lidar", "laser_front"): 0.004, ("camera", "laser_front"): 0.012}
STDDEV = {"lidar": 0.0, "camera": 0.001, "laser_front": 0.002}


@pytest.fixture(scope="module")
def detected() -> DetectedRig:
    """A lidar, which is the root, a camera and a laser, all of which detect the board in five captures."""
    found = detect_rig()
    by_capture = {
        name: {k: of_one[k] for k in range(CAPTURES)} for name, of_one in found.captures.detections.items()
    }
    captures = replace(found.captures, holds=found.captures.holds[:CAPTURES], detections=by_capture, rejections={})
    return replace(found, captures=captures)


def without(captures: CaptureSet, missing: Mapping[tuple[int, str], str]) -> CaptureSet:
    """The captures without some detections, by capture and sensor, for the reasons given."""
    detections = {
        name: {k: found for k, found in of_one.items() if (k, name) not in missing}
        for name, of_one in captures.detections.items()
    }
    return replace(captures, detections=detections, rejections=missing)


def estimate_of(detected: DetectedRig, a: str, b: str, outliers: tuple[int, ...]) -> PairwiseEstimate:
    """The pair of two sensors from all captures that both detected."""
    common = sorted(set(detected.captures.detections[a]) & set(detected.captures.detections[b]))
    matches = np.array([(k, 0, 0) for k in common], dtype=np.intp)
    T_a_b = se3.inverse(detected.T_root_sensor[a]) @ detected.T_root_sensor[b]
    residuals = np.full(len(common), RESIDUALS[a, b])
    return PairwiseEstimate(a, b, T_a_b, np.eye(6), matches, ~np.isin(common, outliers), residuals)


def assemble(
    detected: DetectedRig,
    pairs: Mapping[tuple[str, str], PairwiseEstimate | Rejected],
    parents: Mapping[str, str],
    rejected: Mapping[tuple[int, str], str] | None = None,
    *,
    used: Mapping[tuple[int, str, int], int] | None = None,
    converged: bool = True,
) -> Calibration:
    """Of the sensors that have a parent, and the root."""
    names = ("lidar", *parents)
    T = {name: detected.T_root_sensor[name] for name in names}
    covariance = np.diag(np.repeat([STDDEV[name] for name in names], 6) ** 2)
    tree = SpanningTree("lidar", parents, T)
    solution = RigSolution("bundle", T, covariance, {}, converged, used=used, rejected=rejected or {})
    return assemble_rig(Problem(detected.rig, detected.captures, pairs, tree, SolverOptions()), tree, solution)


def all_pairs(
    detected: DetectedRig, outliers: Mapping[tuple[str, str], tuple[int, ...]]
) -> dict[tuple[str, str], PairwiseEstimate | Rejected]:
    return {names: estimate_of(detected, *names, outliers.get(names, ())) for names in RESIDUALS}


CONNECTED = {"camera": "lidar", "laser_front": "camera"}


def row(calibration: Calibration, capture: int, sensor: str) -> CaptureRow:
    (found,) = (r for r in calibration.evidence.captures if (r.capture, r.sensor) == (capture, sensor))
    return found


def test_a_row_has_the_residuals_of_all_pairs_of_its_sensor(detected: DetectedRig) -> None:
    calibration = assemble(detected, all_pairs(detected, {("camera", "laser_front"): (1,)}), CONNECTED)
    found = [row(calibration, k, name) for k in (0, 1) for name in ("lidar", "camera", "laser_front")]
    rms = [np.hypot(0.003, 0.004), np.hypot(0.003, 0.012), np.hypot(0.004, 0.012)]
    expected = [*(np.array(rms) / np.sqrt(2)), rms[0] / np.sqrt(2), 0.003, 0.004]
    assert [r.residual for r in found] == pytest.approx(expected)
    assert all(r.used and r.reason == "" for r in found)


def test_rows_are_of_all_holds_and_sensors_with_times_from_the_start(detected: DetectedRig) -> None:
    rows = assemble(detected, all_pairs(detected, {}), CONNECTED).evidence.captures
    assert [(r.capture, r.sensor) for r in rows] == [(k, n) for k in range(CAPTURES) for n in detected.rig.sensors]
    hold, start = detected.captures.holds[1], detected.captures.start
    assert (rows[3].start, rows[3].end) == (hold.start - start, hold.end - start)


def test_a_row_states_why_its_detection_was_not_used(detected: DetectedRig) -> None:
    missing = {(1, "laser_front"): "no line", (4, "lidar"): "no plane", (4, "laser_front"): "no line"}
    partial = replace(detected, captures=without(detected.captures, missing))
    outliers = {("lidar", "laser_front"): (2,), ("camera", "laser_front"): (2,)}
    rejected = {(3, "camera"): "outlier of the bundle"}
    views = {(k, name) for name, found in partial.captures.detections.items() for k in found} - {
        *missing,
        *rejected,
    }
    used = {(k, name, 0): k for k, name in views - {(2, "laser_front"), (4, "camera")}}
    calibration = assemble(partial, all_pairs(partial, outliers), CONNECTED, rejected, used=used)
    expected = {
        (1, "laser_front"): "no line",
        (2, "laser_front"): "outlier with respect to the other sensors",
        (3, "camera"): "outlier of the bundle",
        (4, "camera"): "no other sensor detected the board",
    }
    for (capture, sensor), reason in expected.items():
        found = row(calibration, capture, sensor)
        assert (found.used, found.reason, found.residual) == (False, reason, None)
    assert row(calibration, 2, "camera").used


def test_distances_between_two_boards_are_no_residuals(detected: DetectedRig) -> None:
    twice = {
        name: {k: (*of, *of) for k, of in found.items()} for name, found in detected.captures.detections.items()
    }
    matches = np.array([(0, 0, 0), (0, 1, 1), (0, 0, 1), (0, 1, 0)], dtype=np.intp)
    inliers, residuals = np.array([True, False, False, False]), np.array([0.003, 0.005, 1.0, 1.0])
    T_a_b = detected.T_root_sensor["camera"]
    pair = PairwiseEstimate("lidar", "camera", T_a_b, np.eye(6), matches, inliers, residuals)
    used = {(0, name, k): k for name in ("lidar", "camera") for k in (0, 1)}
    two_boards = replace(detected, captures=replace(detected.captures, detections=twice))
    calibration = assemble(two_boards, {("lidar", "camera"): pair}, {"camera": "lidar"}, used=used)
    assert row(calibration, 0, "camera").residual == pytest.approx(np.hypot(0.003, 0.005) / np.sqrt(2))


def test_a_sensor_without_a_relative_pose_has_no_outliers(detected: DetectedRig) -> None:
    pairs = all_pairs(detected, {}) | {
        names: Rejected("too few captures") for names in RESIDUALS if "laser_front" in names
    }
    calibration = assemble(detected, pairs, {"camera": "lidar"})
    reasons = {r.reason for r in calibration.evidence.captures if r.sensor == "laser_front"}
    assert reasons == {"no relative pose of it and another sensor was estimated"}


def test_edges_count_shared_captures_and_inliers(detected: DetectedRig) -> None:
    partial = replace(detected, captures=without(detected.captures, {(1, "laser_front"): "no line"}))
    pairs = all_pairs(partial, {("lidar", "camera"): (0, 3)}) | {
        ("lidar", "laser_front"): Rejected("contradiction")
    }
    edges = assemble(partial, pairs, CONNECTED).evidence.edges
    found = [(e.captures, e.inliers, e.in_tree, e.note, e.residuals.tolist()) for e in edges]
    assert found == [
        (5, 3, True, "", [0.003] * 3),
        (4, 0, False, "contradiction", []),
        (4, 4, True, "", [0.012] * 4),
    ]


def test_sensors_have_poses_parents_and_covariances_with_the_root_first(detected: DetectedRig) -> None:
    """The solution's order is lidar, laser, camera; that of the rig is camera, lidar, laser."""
    calibration = assemble(detected, all_pairs(detected, {}), {"laser_front": "lidar", "camera": "laser_front"})
    assert [s.name for s in calibration.sensors] == ["lidar", "camera", "laser_front"]
    assert [s.parent for s in calibration.sensors] == [None, "laser_front", "lidar"]
    assert [s.verdict.grade for s in calibration.sensors] == ["good"] * 3
    stddev = [STDDEV[s.name] for s in calibration.sensors]
    np.testing.assert_allclose(np.sqrt(np.diag(calibration.joint_covariance)), np.repeat(stddev, 6))
    for sensor in calibration.sensors:
        np.testing.assert_array_equal(sensor.T_root_sensor, detected.T_root_sensor[sensor.name])


def test_without_convergence_no_pose_is_good(detected: DetectedRig) -> None:
    calibration = assemble(detected, all_pairs(detected, {}), CONNECTED, converged=False)
    reason = (
        "the joint solution has not converged; check target and intrinsics in rig.yaml, and record more captures"
    )
    assert [(s.verdict.grade, s.verdict.reason) for s in calibration.sensors] == [("weak", reason)] * 3


def test_an_unconnected_sensor_has_the_reasons_of_its_pairs(detected: DetectedRig) -> None:
    pairs = all_pairs(detected, {}) | {
        ("lidar", "laser_front"): Rejected("too few"),
        ("camera", "laser_front"): Rejected("no inliers"),
    }
    calibration = assemble(detected, pairs, {"camera": "lidar"})
    assert [s.name for s in calibration.sensors] == ["lidar", "camera"]
    assert calibration.evidence.unconnected == {
        "laser_front": "detected the board in 5 captures, but lidar: too few; camera: no inliers"
    }


def test_a_sensor_without_detections_has_the_commonest_reason(detected: DetectedRig) -> None:
    missing = {(k, "laser_front"): "no line" if k in (1, 2, 4) else "too short" for k in range(CAPTURES)}
    partial = replace(detected, captures=without(detected.captures, missing))
    pairs: dict[tuple[str, str], PairwiseEstimate | Rejected] = {
        ("lidar", "camera"): estimate_of(partial, "lidar", "camera", ()),
        ("lidar", "laser_front"): Rejected("no capture in which both detected the board"),
    }
    assert assemble(partial, pairs, {"camera": "lidar"}).evidence.unconnected == {
        "laser_front": "detected the board in none of 5 captures, mostly because: no line"
    }


def test_a_root_without_detections_is_named_for_all_sensors(detected: DetectedRig) -> None:
    missing = {(k, "lidar"): "no plane" for k in range(CAPTURES)}
    partial = replace(detected, captures=without(detected.captures, missing))
    unconnected = assemble(partial, {}, {}).evidence.unconnected
    of_root = "the root lidar detected the board in none of 5 captures, mostly because: no plane"
    reason = f"detected the board in 5 captures, but no other sensor did; {of_root}"
    assert unconnected == dict.fromkeys(("camera", "laser_front"), reason)


def solve_with_wrong_prior(detected: DetectedRig) -> RigSolution:
    """The joint solution with a prior of the laser, whose standard deviation is 0.1 m, 1 m off."""
    solution = detected.solve()
    solved = solution.solved_bundle
    assert solved is not None
    laser = solved.bundle.sensors.index("laser_front")
    T = solved.minimized.state.T_root_sensor[laser] @ se3.pose(np.eye(3), np.array([1.0, 0, 0]))
    bundle = replace(solved.bundle, priors=(SensorPrior(laser, T, 1e2 * np.eye(6)),))
    minimized = minimize_bundle(bundle, solved.minimized.state)
    return replace(solution, solved_bundle=replace(solved, bundle=bundle, minimized=minimized))


def test_a_contradicted_prior_is_first_in_the_verdict(detected: DetectedRig) -> None:
    tree = SpanningTree("lidar", CONNECTED, detected.T_root_sensor)
    rig = detected.rig.model_copy(update={"tolerance": Tolerance(translation=0.1, rotation=5)})
    problem = Problem(rig, detected.captures, all_pairs(detected, {}), tree, SolverOptions())
    found = assemble_rig(problem, tree, solve_with_wrong_prior(detected))
    reasons = found["laser_front"].verdict.reason.split("; ")
    assert reasons[0].startswith("the prior of laser_front disagrees with the captures by ")
    assert found["camera"].verdict.grade == "good"


def test_pairs_show_inconsistent_sensors_of_the_baseline_only(detected: DetectedRig) -> None:
    pairs = {
        names: replace(pair, normalized_rms=5.0 if "laser_front" in names else 1.0)
        for names, pair in all_pairs(detected, {}).items()
        if isinstance(pair, PairwiseEstimate)
    }
    assert "against all other sensors" in assemble(detected, pairs, CONNECTED)["laser_front"].verdict.reason
    tree = SpanningTree("lidar", CONNECTED, detected.T_root_sensor)
    problem = Problem(detected.rig, detected.captures, pairs, tree, SolverOptions())
    found = assemble_rig(problem, tree, detected.solve())
    assert "against all other sensors" not in found["laser_front"].verdict.reason


def test_cross_validation_is_in_the_evidence_and_in_the_verdict(detected: DetectedRig) -> None:
    tree = SpanningTree("lidar", CONNECTED, detected.T_root_sensor)
    problem = Problem(detected.rig, detected.captures, all_pairs(detected, {}), tree, SolverOptions())
    held_out = {"camera": HeldOutError(10, "px", 3.0, 2.0, 4.0), "lidar": HeldOutError(10, "m", 0.01, 0.01, 1.0)}
    found = assemble_rig(problem, tree, detected.solve(), held_out)
    assert found.evidence.cross_validation == held_out
    (remark,) = [text for text in found.evidence.remarks if "held-out" in text]
    assert remark in found["camera"].verdict.reason
    assert found["camera"].verdict.grade != "good"


def test_findings_in_the_recording_are_remarks_and_make_their_sensors_weak(detected: DetectedRig) -> None:
    findings = (Finding("a slip"), Finding("it zooms", ("camera",)), Finding("a copy", ("camera",)))
    found = replace(detected, captures=replace(detected.captures, findings=findings))
    calibration = assemble(found, all_pairs(detected, {}), CONNECTED)
    assert calibration.evidence.remarks == ("a slip", "it zooms", "a copy")
    assert calibration["camera"].verdict == Verdict("weak", "it zooms; a copy")
    assert calibration["laser_front"].verdict == Verdict("good")


def test_no_pose_in_the_frame_of_a_weak_root_is_good(detected: DetectedRig) -> None:
    findings = (Finding("it is bent", ("lidar",)), Finding("it zooms", ("camera",)))
    found = replace(detected, captures=replace(detected.captures, findings=findings))
    calibration = assemble(found, all_pairs(detected, {}), CONNECTED)
    assert calibration["lidar"].verdict == Verdict("weak", "it is bent")
    assert calibration["camera"].verdict == Verdict("weak", "it zooms")
    of_root = "the root lidar is weak, in whose frame the pose is"
    assert calibration["laser_front"].verdict == Verdict("weak", of_root)
