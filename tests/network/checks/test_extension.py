"""Extension of a network: prior, scanners that only the earlier calibration has, and moved scanners."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigvalsh

from calgraph.config.settings import DiagnosticsSettings
from calgraph.errors import CalibrationError, InputError
from calgraph.geometry import Array, se2
from calgraph.network.checks.extension import (
    EARLIER_WEIGHT,
    _mark_kept,
    build_consistent_prior,
    extract_earlier_poses,
    merge_calibrations,
    remove_scanners,
)
from calgraph.network.joint.error_sources import EARLIER
from calgraph.network.joint.planar_poses import (
    NetworkPoses,
    ScannerPrior,
    build_scanner_prior,
    extract_planar_poses,
)
from calgraph.network.joint.scanner_matrix import ScannerMatrix, ScannerOrder
from calgraph.result import Calibration, Edge, ErrorBudget, ErrorSource, Verdict
from known_networks import calibration, four_scanners

SETTINGS = DiagnosticsSettings()
REMARK = "its pose is that of the earlier calibration: this recording does not determine it"


def empty_matrix() -> ScannerMatrix:
    """Of four scanners with four unknowns each."""
    return ScannerMatrix.zeros(ScannerOrder.complete(4, 4))


def test_the_gradient_of_the_prior_equals_finite_differences() -> None:
    rng = np.random.default_rng(0)
    poses = four_scanners(rng)
    prior = build_scanner_prior(poses, ("a", "x", "c", "b"))
    assert prior.nodes.tolist() == [2, 3]
    T = np.stack([np.eye(3), np.eye(3), poses.T_root_scanner[2], poses.T_root_scanner[1]])
    T = se2.retract(T, rng.normal(0, 0.02, (4, 3)))

    def cost(step: Array) -> float:
        return prior.add_to_equations(se2.retract(T, step.reshape(4, 4)[:, :3]), empty_matrix(), np.zeros(16))

    H, g = empty_matrix(), np.zeros(16)
    prior.add_to_equations(T, H, g)
    numerical = [(cost(h) - cost(-h)) / 2e-6 for h in 1e-6 * np.eye(16)]
    np.testing.assert_allclose(g, numerical, rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(H.select(np.arange(16))[8], _slope(prior, T, 8), rtol=1e-5, atol=1e-3)


def _slope(prior: ScannerPrior, T: Array, column: int) -> Array:
    """The derivative of the gradient by one unknown."""
    slopes = []
    for sign in (1, -1):
        step = sign * 1e-6 * np.eye(16)[column].reshape(4, 4)
        g = np.zeros(16)
        prior.add_to_equations(se2.retract(T, step[:, :3]), empty_matrix(), g)
        slopes.append(g)
    return np.asarray((slopes[0] - slopes[1]) / 2e-6)


def test_errors_of_kept_and_estimated_scanners_are_correlated() -> None:
    """Linear theory by sampling: b and c are measured again, d is kept; 4,000 samples."""
    sampled, together = sample_extension(0.0)
    np.testing.assert_allclose(sampled[:6, 6:], together[:6, 6:], atol=0.1)


@pytest.mark.parametrize("correlation", [-1.0, 0.0, 0.7, 1.0])
def test_the_covariance_of_an_extension_is_not_too_small_for_correlated_errors(correlation: float) -> None:
    """Errors that last are the same in both recordings, so that no second one makes them smaller."""
    sampled, together = sample_extension(correlation)
    # Of what was measured again; by chance, the largest of six ratios of 4,000 samples is up to 1.1.
    assert eigvalsh(sampled[:6, :6], together[:6, :6]).max() < 1.12


def test_an_extension_by_the_same_errors_keeps_the_covariance() -> None:
    sampled, together = sample_extension(1.0)
    np.testing.assert_allclose(np.diag(sampled)[:6], np.diag(together)[:6], rtol=0.15)


def sample_extension(correlation: float) -> tuple[Array, Array]:
    """Sampled and stated covariance (9, 9) of three scanners, scaled by the latter: two are measured again.

    Errors of both measurements are as large as each other, and have this correlation.
    """
    rng = np.random.default_rng(3)
    poses = four_scanners(rng)
    prior = build_scanner_prior(poses, ("a", "b", "c"))
    measured = np.linalg.inv(prior.information)
    posterior = np.linalg.inv(prior.information + np.linalg.inv(measured))
    spread = np.zeros((9, 9))
    spread[3:, 3:] = posterior / EARLIER_WEIGHT
    found = calibration(NetworkPoses(("a", "b", "c"), poses.T_root_scanner[:3], spread))
    together = extract_planar_poses(merge_calibrations(found, calibration(poses), prior)).covariance[3:, 3:]
    old = rng.multivariate_normal(np.zeros(9), poses.covariance[3:, 3:], 4000)
    own = rng.multivariate_normal(np.zeros(6), measured, 4000)
    new = correlation * old[:, :6] + np.sqrt(1 - correlation**2) * own
    fused = (old[:, :6] @ prior.information + new @ np.linalg.inv(measured)) @ posterior
    size = np.sqrt(np.diag(together))
    scale = np.outer(size, size)
    return np.cov(np.column_stack([fused, old[:, 6:]]).T) / scale, together / scale


def extend_by(factors: Array) -> Array:
    """Covariance (9, 9) of an extension that adds little, whose variances tests enlarge by factors (3,).

    Errors of its scanners are nearly the same, by 1 cm and 10 mrad.
    """
    common = np.kron(np.ones((3, 3)) + 0.05 * np.eye(3), 1e-4 * np.eye(3))
    poses = replace(four_scanners(np.random.default_rng(3)), covariance=np.pad(common, (3, 0)))
    prior = build_scanner_prior(poses, ("a", "b", "c"))
    scale, spread = np.repeat(np.sqrt(factors), 3), np.zeros((9, 9))
    spread[3:, 3:] = np.linalg.inv(1.01 * prior.information) / EARLIER_WEIGHT
    found = calibration(NetworkPoses(("a", "b", "c"), poses.T_root_scanner[:3], spread * np.outer(scale, scale)))
    merged = merge_calibrations(found, calibration(poses), prior, factors)
    return extract_planar_poses(merged).covariance[3:, 3:]


def test_what_tests_add_to_variances_is_no_error_of_the_earlier_poses() -> None:
    """Ten times the variances leave the covariance with a kept scanner as it is."""
    plain, enlarged = extend_by(np.ones(3)), extend_by(np.full(3, 10.0))
    np.testing.assert_allclose(enlarged[:6, :6], 10 * plain[:6, :6])
    np.testing.assert_allclose(enlarged[:6, 6:], plain[:6, 6:])


@pytest.mark.parametrize("factors", [(1.0, 1.0, 1.0), (10.0, 10.0, 10.0), (1.0, 1.0, 100.0), (1.0, 100.0, 10.0)])
def test_the_covariance_of_an_extension_is_positive(factors: tuple[float, float, float]) -> None:
    covariance = extend_by(np.array(factors))
    size = np.sqrt(np.diag(covariance))
    assert np.linalg.eigvalsh(covariance / np.outer(size, size)).min() > 1e-3


def test_a_kept_scanner_keeps_its_pose_with_a_remark() -> None:
    poses = four_scanners(np.random.default_rng(3))
    found = calibration(poses.select(("a", "b", "c")))
    both = merge_calibrations(found, calibration(poses), build_scanner_prior(poses, ("a", "b", "c")))
    assert [sensor.name for sensor in both.sensors] == ["a", "b", "c", "d"]
    np.testing.assert_allclose(both["d"].T_root_sensor, calibration(poses)["d"].T_root_sensor)
    assert "earlier calibration" in both["d"].verdict.reason


def test_errors_of_kept_scanners_are_of_the_earlier_calibration() -> None:
    poses = four_scanners(np.random.default_rng(3))
    found = calibration(poses.select(("a", "b", "c")))
    sources, shares = (ErrorSource("noise"), EARLIER), np.array([0.3, 0.7])
    T = [sensor.T_root_sensor for sensor in found.sensors]
    budget = ErrorBudget.of_poses(sources, shares[:, None, None] * found.joint_covariance, T)
    prior = build_scanner_prior(poses, ("a", "b", "c"))
    both = merge_calibrations(replace(found, budget=budget), calibration(poses), prior)
    assert both.budget is not None
    assert both.budget.covariance is not None
    np.testing.assert_allclose(both.budget.covariance.sum(axis=0), both.joint_covariance, rtol=1e-9)
    measured = [0, 1, 5]
    np.testing.assert_allclose(both.budget.shares(1)[:, measured], np.tile(shares[:, None], 3))
    np.testing.assert_allclose(both.budget.shares(3)[:, measured], np.tile([[0.0], [1.0]], 3))


def test_an_extension_of_a_calibration_without_budget_has_none() -> None:
    poses = four_scanners(np.random.default_rng(3))
    prior = build_scanner_prior(poses, ("a", "b", "c"))
    assert merge_calibrations(calibration(poses.select(("a", "b", "c"))), calibration(poses), prior).budget is None


def test_children_of_a_removed_scanner_get_the_root_as_parent() -> None:
    old = remove_scanners(calibration(four_scanners(np.random.default_rng(0))), ("c",))
    assert [(sensor.name, sensor.parent) for sensor in old.sensors] == [("a", None), ("b", "a"), ("d", "a")]
    assert old.joint_covariance is not None
    assert old.joint_covariance.shape == (18, 18)


def test_another_root_is_refused() -> None:
    with pytest.raises(InputError, match=r"in the frame of a, not b"):
        extract_earlier_poses(calibration(four_scanners(np.random.default_rng(0))), "b")


@pytest.mark.parametrize(("name", "message"), [("a", "is the root"), ("z", "z is not in what is extended")])
def test_root_and_unknown_scanners_cannot_be_removed(name: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        remove_scanners(calibration(four_scanners(np.random.default_rng(0))), (name,))


def edge(a: str, b: str, inliers: int) -> Edge:
    return Edge(a, b, 2 * inliers, inliers, in_tree=False, residuals=np.zeros(0))


def with_edges(calibration: Calibration, *edges: Edge) -> Calibration:
    return replace(calibration, evidence=replace(calibration.evidence, edges=edges))


def test_edges_are_those_of_the_recording_and_others_between_kept_scanners() -> None:
    poses = four_scanners(np.random.default_rng(3))
    found = with_edges(calibration(poses.select(("a", "b", "c"))), edge("a", "b", 10))
    # z was not connected to the earlier network.
    earlier = with_edges(calibration(poses), edge("a", "b", 7), edge("c", "d", 8), edge("d", "z", 9))
    merged = merge_calibrations(found, earlier, build_scanner_prior(poses, ("a", "b", "c")))
    edges = [(one.sensor_a, one.sensor_b, one.inliers) for one in merged.evidence.edges]
    assert edges == [("a", "b", 10), ("c", "d", 8)]


def known_to_millimetres(rng: np.random.Generator) -> NetworkPoses:
    """With standard deviations of 1 mm and 0.1 mrad."""
    return replace(four_scanners(rng), covariance=np.diag([0.0] * 3 + 3 * [1e-6, 1e-6, 1e-8]))


def test_a_recording_that_agrees_gives_the_earlier_poses_as_a_prior(rng: np.random.Generator) -> None:
    earlier = known_to_millimetres(rng)
    prior = build_consistent_prior(earlier, earlier.select(("a", "b", "c")), "a", SETTINGS)
    np.testing.assert_array_equal(prior.T_root_scanner, earlier.T_root_scanner[1:3])


@pytest.mark.parametrize(
    ("moved", "root", "advice"),
    [
        (2, "a", "give `moved`: c"),
        (0, "a", "its root has moved: calibrate the network again"),
        (2, "c", "its root has moved: calibrate the network again"),
        (0, "c", "give `moved`: a"),
    ],
)
def test_moved_scanners_are_named_with_advice(
    moved: int, root: str, advice: str, rng: np.random.Generator
) -> None:
    """Also where the result has another root than what it is solved against."""
    earlier = known_to_millimetres(rng)
    T = earlier.T_root_scanner.copy()
    T[moved, :2, 2] += [0.03, 0.04]
    found = replace(earlier, T_root_scanner=se2.inverse(T[0]) @ T)
    with pytest.raises(CalibrationError, match=rf"{earlier.names[moved]} has moved by 50\.0 mm .*{advice}"):
        build_consistent_prior(earlier, found, root, SETTINGS)


def test_edges_of_removed_scanners_are_removed() -> None:
    earlier = calibration(four_scanners(np.random.default_rng(0)))
    earlier = with_edges(earlier, edge("a", "b", 7), edge("b", "c", 8), edge("c", "d", 9))
    edges = remove_scanners(earlier, ("c",)).evidence.edges
    assert [(one.sensor_a, one.sensor_b) for one in edges] == [("a", "b")]


def test_a_calibration_that_is_not_of_a_network_cannot_be_extended() -> None:
    found = calibration(four_scanners(np.random.default_rng(0)))
    with_camera = replace(found, sensors=(*found.sensors[:3], replace(found.sensors[3], kind="camera")))
    with pytest.raises(InputError, match=r"^`extend`: "):
        extract_earlier_poses(with_camera, "a")


@pytest.mark.parametrize(
    ("before", "after"),
    [("", REMARK), ("height of east: move", f"height of east: move; {REMARK}"), (REMARK, REMARK)],
)
def test_the_remark_of_a_kept_scanner_follows_the_reason_of_its_grade_once(before: str, after: str) -> None:
    sensor = calibration(four_scanners(np.random.default_rng(0))).sensors[1]
    kept = _mark_kept(replace(sensor, verdict=Verdict("weak", before)))
    assert kept.verdict == Verdict("weak", after)
