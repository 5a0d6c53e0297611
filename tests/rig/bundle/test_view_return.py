"""Detections that are outliers of all pairs return if they agree with the bundle, and the tails of priors."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest

from calgraph.boards.detections import BoardCorners, Detection, PlanePatch, to_beams
from calgraph.geometry import plane, se3, so3
from calgraph.rig.bundle.board_observations import BoardObservation
from calgraph.rig.bundle.bundle_setup import build_bundle
from calgraph.rig.bundle.bundle_solver import linearize_bundle
from calgraph.rig.bundle.estimate import solve_bundle
from calgraph.rig.bundle.solution import RigSolution
from calgraph.simulation import CameraOptions, LaserOptions, MultibeamOptions
from detected_rigs import QUICK, DetectedRig, detect_rig

EXCLUDED = range(0, 60, 4)
TWO_LIDARS = MultibeamOptions(count=2, resolution=2.0)


@pytest.fixture(scope="module")
def detected() -> DetectedRig:
    return detect_rig()


def solve_without(one: DetectedRig, sensor: str, captures: Collection[int]) -> RigSolution:
    """The solution where some detections of a sensor are outliers of all pairs."""
    pairs = [
        replace(pair, inliers=~np.isin(pair.matches[:, 0], list(captures)))
        if sensor in (pair.sensor_a, pair.sensor_b)
        else pair
        for pair in one.pairs()
    ]
    return solve_bundle(one.rig, one.captures, pairs, one.T_root_sensor)


@pytest.mark.parametrize("sensor", ["camera", "lidar"])
def test_outliers_of_pairs_that_agree_with_the_bundle_return(detected: DetectedRig, sensor: str) -> None:
    joint = solve_without(detected, sensor, EXCLUDED)
    by_sensor = detected.captures.detections
    shared = {c for name in by_sensor if name != sensor for c in by_sensor[name]}
    missing = {(c, sensor, 0) for c in EXCLUDED if c in by_sensor[sensor] and c in shared}
    assert joint.used is not None
    assert missing <= joint.used.keys()
    complete = detected.solve()
    assert joint.solved_bundle is not None
    assert complete.solved_bundle is not None
    assert sum(len(v.board) for v in joint.solved_bundle.bundle.views) == sum(
        len(v.board) for v in complete.solved_bundle.bundle.views
    )
    for name, T in complete.T_root_sensor.items():
        stddev = np.sqrt(np.diag(complete.covariance[name])[:3]).max()
        assert np.linalg.norm((joint.T_root_sensor[name] - T)[:3, 3]) <= 0.3 * stddev


def test_outliers_that_contradict_the_bundle_stay_out(detected: DetectedRig) -> None:
    """The board is farther away than it was for the other sensors in every second excluded capture."""
    by_capture, slipped = detected.captures.detections["camera"], list(EXCLUDED)[::2]
    outliers = {id(by_capture[c][0]) for c in slipped if c in by_capture}

    def slip(_name: str, detection: Detection) -> Detection:
        if id(detection) in outliers and isinstance(detection, BoardCorners):
            middle = detection.pixels.mean(axis=0)
            return replace(detection, pixels=middle + 0.9 * (detection.pixels - middle))
        return detection

    joint = solve_without(detected.map_detections(slip), "camera", EXCLUDED)
    assert joint.used is not None
    used = {capture for capture, name, _ in joint.used if name == "camera"}
    assert used & set(EXCLUDED) == (set(EXCLUDED) - set(slipped)) & set(by_capture)
    assert {capture for capture, name in joint.rejected if name == "camera"} == set(slipped) & set(by_capture)


def test_ambiguous_detections_do_not_return(detected: DetectedRig) -> None:
    """Two planes in each excluded capture of the LiDAR, of which no pair has either as inlier."""
    by_sensor = dict(detected.captures.detections)
    by_sensor["lidar"] = {
        c: (*found, *found) if c in EXCLUDED else found for c, found in by_sensor["lidar"].items()
    }
    captures = replace(detected.captures, detections=by_sensor)
    joint = solve_without(replace(detected, captures=captures), "lidar", EXCLUDED)
    assert joint.used is not None
    assert not [capture for capture, name, _ in joint.used if name == "lidar" and capture in EXCLUDED]


def test_priors_have_tails(detected: DetectedRig) -> None:
    """Gaussian up to a limit; beyond, the gradient of the cost falls with the deviation."""
    joint = detected.solve().solved_bundle
    assert joint is not None
    bundle, state = joint.bundle, joint.minimized.state
    stddev = np.array([one.prior_stddev for one in bundle.extra_parameters])
    first = 6 * bundle.body_count
    views = bundle.with_views([v.select(np.zeros(len(v.board), dtype=np.bool_)) for v in bundle.all_views])
    for deviation, weight in ((1.0, 1.0), (3.0, 1.0), (6.0, 0.25), (30.0, 0.01)):
        at = linearize_bundle(views, replace(state, extra=deviation * stddev))
        assert bundle.prior_weights(deviation * stddev)[first:] == pytest.approx(weight)
        ahead = linearize_bundle(views, replace(state, extra=(deviation + 1e-5) * stddev))
        assert (ahead.cost - at.cost) / 1e-5 == pytest.approx(len(stddev) * weight * deviation, rel=1e-3)
        assert at.g[first:] * stddev == pytest.approx(weight * deviation)


def test_a_board_starts_at_the_detection_that_locates_it_however_far_away_the_others_are() -> None:
    """Two LiDARs, of which the second takes a plane 30 m away, at another angle, for the board."""
    parts = {"camera": CameraOptions(count=0), "laser": LaserOptions(count=0), "multibeam": TWO_LIDARS}
    one = detect_rig(QUICK.model_copy(update=parts))
    first, second = one.T_root_sensor
    away = se3.pose(so3.exp(np.array([0.3, 1.5, 0.1])), np.array([-30.0, 0.0, 0.5]))

    def mistake(name: str, detection: Detection) -> Detection:
        if name == first or not isinstance(detection, PlanePatch):
            return detection
        ranges, directions = to_beams(se3.apply(away, detection.points))
        return replace(
            detection,
            plane=plane.transform(away, detection.plane),
            ranges=ranges,
            directions=directions,
            center=se3.apply(away, detection.center[None])[0],
        )

    captures = one.map_detections(mistake).captures
    (capture, (detected, *_)), *_ = captures.detections[first].items()
    assert isinstance(detected, PlanePatch)
    boards = [BoardObservation(capture, {first: 0, second: 0}, unmatched=frozenset({first, second}))]
    _, start = build_bundle(one.rig, captures, boards, one.T_root_sensor)
    np.testing.assert_allclose(plane.from_pose(start.T_root_board[0]), detected.plane, atol=0.02)
