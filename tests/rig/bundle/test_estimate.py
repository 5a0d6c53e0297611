"""The default estimator as a whole: near the Cramér–Rao bound, honest, robust, and with few or strange sensors."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from calgraph.geometry import Array, se3
from calgraph.rig.bundle.estimate import solve_bundle
from calgraph.rig.bundle.solution import RigSolution
from calgraph.simulation import CameraOptions, LaserOptions, MultibeamOptions, build_world
from detected_rigs import QUICK, DetectedRig, detect_rig, detect_rig_on
from efficiency import solve_at_truth

pytestmark = pytest.mark.slow

RUNS = 10
CONFIDENCE = 0.998
SMALL = QUICK.model_copy(update={"samples": 1})
DISTURBED = QUICK.model_copy(update={"disturbed": 0.2})


@pytest.fixture(scope="module")
def runs() -> list[tuple[DetectedRig, RigSolution]]:
    stage = build_world(SMALL, 1, images=False)
    found = [detect_rig_on(stage, seed) for seed in range(RUNS)]
    return [(one, one.solve()) for one in found]


def bound(one: DetectedRig) -> dict[str, Array]:
    T_root_board = {i: board.T_root_board for i, board in enumerate(one.truth.boards)}
    return solve_at_truth(one.rig, one.captures, one.T_root_sensor, T_root_board)[0]


def interval(count: int) -> tuple[float, float]:
    """99 % interval of the mean of that many squared standard normal numbers."""
    low, high = chi2.ppf([(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], count) / count
    return float(low), float(high)


@pytest.mark.parametrize("name", ["camera", "laser_front"])
def test_errors_are_those_of_the_cramer_rao_bound(runs: list[tuple[DetectedRig, RigSolution]], name: str) -> None:
    errors = [se3.difference(joint.T_root_sensor[name], one.T_root_sensor[name]) for one, joint in runs]
    squared = [e @ np.linalg.solve(bound(one)[name], e) / 6 for e, (one, _) in zip(errors, runs, strict=True)]
    low, high = interval(6 * RUNS)
    # Estimating the noise costs a few percent.
    assert low < np.mean(squared) < 1.1 * high


@pytest.mark.parametrize("name", ["camera", "laser_front"])
def test_errors_are_consistent_with_the_covariance(runs: list[tuple[DetectedRig, RigSolution]], name: str) -> None:
    low, high = interval(6 * RUNS)
    nees = np.mean([one.mahalanobis(joint, name) for one, joint in runs])
    # A view bias that chance makes appear widens the covariance of a rig without any.
    assert 0.8 * low < nees < 1.1 * high


def test_no_inlier_is_rejected(runs: list[tuple[DetectedRig, RigSolution]]) -> None:
    assert sum(len(joint.rejected) for _, joint in runs) <= 1


def test_estimated_noise_is_the_stated_one(runs: list[tuple[DetectedRig, RigSolution]]) -> None:
    scales = np.array([[noise.scale for noise in joint.noise.values()] for _, joint in runs])
    np.testing.assert_allclose(scales.mean(axis=0), 1.0, atol=0.05)


def test_outliers_in_a_fifth_of_the_captures_cost_little() -> None:
    calm, slipping = (build_world(one, 1, images=False) for one in (QUICK, DISTURBED))
    squares = np.zeros(2)
    for seed in range(3):
        for i, stage in enumerate((calm, slipping)):
            one = detect_rig_on(stage, seed)
            # Pairs keep the disturbed captures as inliers.
            error = se3.difference(one.solve().T_root_sensor["camera"], one.T_root_sensor["camera"])
            squares[i] += error @ np.linalg.solve(bound(one)["camera"], error)
    assert np.sqrt(squares[1] / squares[0]) < 2


def test_rejected_views_are_of_disturbed_captures() -> None:
    one = detect_rig(DISTURBED)
    rejected = {capture for capture, _ in one.solve().rejected}
    disturbed = {i for i, board in enumerate(one.truth.boards) if board.disturbed}
    assert rejected
    assert len(rejected - disturbed) <= 1


def test_scanners_suffice_without_cameras() -> None:
    blind = detect_rig(QUICK.model_copy(update={"camera": CameraOptions(count=0)}))
    joint = blind.solve()
    assert joint.converged
    assert blind.mahalanobis(joint, "laser_front") < 3


@pytest.mark.parametrize(
    "others",
    [
        {"laser": LaserOptions(count=0)},
        {"multibeam": MultibeamOptions(count=0)},
        {"laser": LaserOptions(count=0), "multibeam": MultibeamOptions(count=0), "camera": CameraOptions(count=2)},
    ],
    ids=["camera and 3-D", "camera and 2-D", "two cameras"],
)
def test_two_sensors_suffice(others: dict[str, object]) -> None:
    pair = detect_rig(QUICK.model_copy(update=others))
    (name,) = set(pair.T_root_sensor) - {pair.rig.root}
    joint = pair.solve()
    assert joint.converged
    assert pair.mahalanobis(joint, name) < 3


def test_a_sensor_without_common_boards_keeps_its_pose() -> None:
    one = detect_rig(SMALL)
    pairs = [pair for pair in one.pairs() if "laser_front" not in (pair.sensor_a, pair.sensor_b)]
    joint = solve_bundle(one.rig, one.captures, pairs, one.T_root_sensor)
    np.testing.assert_allclose(joint.T_root_sensor["laser_front"], one.T_root_sensor["laser_front"], atol=1e-9)
    assert joint.covariance["laser_front"][0, 0] == pytest.approx(100.0)
    assert one.mahalanobis(joint, "camera") < 3


def test_a_rough_start_ends_where_a_good_one_does() -> None:
    one, rng = detect_rig(SMALL), np.random.default_rng(0)
    rough = {
        n: se3.retract(T, (n != one.rig.root) * 0.1 * rng.normal(size=6)) for n, T in one.T_root_sensor.items()
    }
    good, found = one.solve(), solve_bundle(one.rig, one.captures, one.pairs(), rough)
    for name, T in good.T_root_sensor.items():
        # One of thirty edges more or fewer may be within the limits at the start.
        stddev = np.sqrt(np.diag(good.covariance[name])) + 1e-9
        assert np.all(np.abs(se3.difference(found.T_root_sensor[name], T)) < 0.2 * stddev)


def test_the_same_problem_gives_the_same_bits() -> None:
    one = detect_rig(SMALL)
    first, second = one.solve(), one.solve()
    for name, T in first.T_root_sensor.items():
        np.testing.assert_array_equal(T, second.T_root_sensor[name])


def test_stated_noise_hardly_matters() -> None:
    one = detect_rig(SMALL)
    doubled = {
        name: spec.model_copy(update={"noise": spec.noise.model_copy(update=_twice(spec.noise.model_dump()))})
        for name, spec in one.rig.sensors.items()
    }
    loud = replace(one, rig=one.rig.model_copy(update={"sensors": doubled}))
    a, b = one.solve(), loud.solve()
    ratio = np.diag(b.covariance["camera"]) / np.diag(a.covariance["camera"])
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)


def _twice(noise: dict[str, float]) -> dict[str, float]:
    return {key: 2 * value for key, value in noise.items() if key in ("pixel", "range")}
