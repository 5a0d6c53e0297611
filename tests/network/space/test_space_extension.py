"""Networks of 3-D LiDARs with the poses of an earlier calibration."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.config.settings import DiagnosticsSettings
from calgraph.errors import CalibrationError, InputError
from calgraph.geometry import se3, so3
from calgraph.network.checks.extension import (
    EARLIER_WEIGHT,
    build_consistent_prior,
    extract_earlier_poses,
    merge_calibrations,
)
from calgraph.network.joint.planar_poses import NetworkPoses, build_scanner_prior, extract_poses
from calgraph.network.space.joint import solve_space
from calgraph.result import Calibration, SensorPose, Verdict
from known_networks import calibration as planar_calibration
from known_networks import four_scanners
from network.space.space_scenes import build_scene, perturb, prior_of

SETTINGS = DiagnosticsSettings()


def random_poses(rng: np.random.Generator) -> NetworkPoses:
    """Four LiDARs with correlated errors of some centimetres."""
    T = np.stack([se3.pose(so3.exp(rng.normal(size=3)), rng.uniform(-5, 5, 3)) for _ in range(4)])
    T[0] = np.eye(4)
    mixed = rng.normal(0, 0.01, (24, 24))
    mixed[:6] = 0
    return NetworkPoses(("a", "b", "c", "d"), T, mixed @ mixed.T)


def calibration(poses: NetworkPoses) -> Calibration:
    sensors = tuple(
        SensorPose(name, "a" if k else None, name, "lidar3d", poses.T_root_scanner[k], Verdict("good"))
        for k, name in enumerate(poses.names)
    )
    return Calibration("a", sensors, poses.covariance)


def test_errors_of_kept_and_estimated_lidars_are_correlated() -> None:
    """Linear theory by sampling: b and c are measured again, d is kept; 4,000 samples."""
    rng = np.random.default_rng(3)
    poses = random_poses(rng)
    prior = build_scanner_prior(poses, ("a", "b", "c"))
    measured = np.diag(np.tile([0.01, 0.02, 0.03, 0.005, 0.01, 0.02], 2) ** 2)
    posterior = np.linalg.inv(prior.information + np.linalg.inv(measured))
    enlarged = posterior / EARLIER_WEIGHT
    found = replace(poses.select(("a", "b", "c")), covariance=np.pad(enlarged, (6, 0)))
    merged = merge_calibrations(calibration(found), calibration(poses), prior)
    assert [one.name for one in merged.sensors] == ["a", "b", "c", "d"]
    together = extract_poses(merged).covariance[6:, 6:]
    old = rng.multivariate_normal(np.zeros(18), poses.covariance[6:, 6:], 4000)
    new = rng.multivariate_normal(np.zeros(12), measured, 4000)
    fused = (old[:, :12] @ prior.information + new @ np.linalg.inv(measured)) @ posterior
    sampled = np.cov(np.column_stack([fused, old[:, 12:]]).T)
    size = np.sqrt(np.diag(sampled))
    sampled, together = sampled / np.outer(size, size), together / np.outer(size, size)
    np.testing.assert_allclose(sampled[:12, 12:], together[:12, 12:], atol=0.1)
    np.testing.assert_allclose(np.diag(together)[:12], 2.0, rtol=0.15)


def test_a_lidar_that_moved_is_named(rng: np.random.Generator) -> None:
    earlier = replace(random_poses(rng), covariance=np.diag([0.0] * 6 + 18 * [1e-6]))
    assert build_consistent_prior(earlier, earlier, "a", SETTINGS).nodes.tolist() == [1, 2, 3]
    T = earlier.T_root_scanner.copy()
    T[2, :3, 3] += [0.03, 0.0, 0.04]
    with pytest.raises(CalibrationError, match=r"c has moved by 50\.0 mm .*give `moved`: c"):
        build_consistent_prior(earlier, replace(earlier, T_root_scanner=T), "a", SETTINGS)


def test_a_planar_calibration_is_refused() -> None:
    with pytest.raises(InputError, match="needs the calibration of a network of 3-D LiDARs"):
        extract_earlier_poses(planar_calibration(four_scanners(np.random.default_rng(0))), "a", in_space=True)


def test_a_known_pose_is_held() -> None:
    """To 0.1 mm, where the recording alone places it 20 mm beside."""
    scene = build_scene(0, duration=6.0, people=2)
    start = perturb(scene.truth, np.random.default_rng(1))
    alone = solve_space(scene.observations, start, prior_of(3))
    T = [state.T_root_sensor for state in scene.truth]
    known = T[1].copy()
    known[:3, 3] += [0.02, 0.0, 0.0]
    poses = NetworkPoses(
        ("lidar_0", "lidar_1"), se3.inverse(T[0]) @ np.stack([T[0], known]), np.diag([0.0] * 6 + [1e-8] * 6)
    )
    earlier = build_scanner_prior(poses, ("lidar_0", "lidar_1", "lidar_2")).express_in(T[0])
    held = solve_space(scene.observations, start, prior_of(3), earlier)
    off = held.states[1].T_root_sensor[:3, 3] - known[:3, 3]
    assert np.abs(off).max() < 1e-3
    # After the bias and scale of the root.
    assert np.all(np.diag(held.covariance)[2:8] < np.diag(alone.covariance)[2:8])
