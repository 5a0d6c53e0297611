"""Views: derivatives of residuals against numerical ones, and the noise of ranges."""

from dataclasses import replace

import numpy as np
import pytest

from bundle_scenes import CAMERA, CORNERS, PIXEL, scene, views_of, with_range_bias
from calgraph.boards.detections import PlanePatch
from calgraph.config import RangeNoise
from calgraph.geometry import Array, se3, so3
from calgraph.rig.bundle.bundle_parameters import LocalParameters
from calgraph.rig.bundle.bundle_setup import _MIN_INCIDENCE_COSINE
from calgraph.rig.bundle.corner_observations import CornerObservations, PrintedCorners
from calgraph.rig.bundle.observations import BoardViews, LinearizedResiduals, relative_poses
from calgraph.rig.bundle.range_observations import RangeObservations
from calgraph.sensors import CameraModel
from calgraph.sensors.kinds import DepthCameraUncertainty, DepthNoise

STEP = 1e-6
PLUMB_BOB = CameraModel("pinhole", 640, 480, CAMERA.K, np.array([-0.25, 0.08, 0.002, -0.003, -0.01]))
RATIONAL = CameraModel("pinhole", 640, 480, CAMERA.K, np.array([0.1, -0.2, 0.001, 0.002, 0.05, 0.3, -0.1, 0.02]))
FISHEYE = CameraModel("fisheye", 640, 480, CAMERA.K, np.array([0.05, -0.01, 0.003, -0.001]))

ORDINARY = se3.pose(so3.exp(np.array([2.8, 0.3, -0.2])), np.array([0.2, -0.1, 2.0]))
UGLY = {
    "at the edge of the picture": se3.pose(so3.exp(np.array([3.0, 0.1, 0.1])), np.array([1.1, 0.8, 1.6])),
    "far away": se3.pose(so3.exp(np.array([3.1, 0.2, 0.1])), np.array([0.5, 0.5, 40.0])),
    "turned by a half turn": se3.pose(np.diag([1.0, -1, -1]), np.array([0.0, 0.0, 1.0])),
    "almost edge-on": se3.pose(so3.exp(np.array([0.0, 1.5, 0.0])) @ np.diag([1.0, -1, -1]), np.array([0, 0, 2.0])),
}


def jacobian(linearized: LinearizedResiduals, views: BoardViews) -> Array:
    """(N·k, 6 + e) by the pose of each measurement's view, and the sensor's extra parameters."""
    view = np.repeat(np.arange(len(views.start)), np.diff(views.start, append=len(linearized.residual)))
    return np.asarray(linearized.jacobian @ linearized.local_jacobian[view]).reshape(
        -1, linearized.local_jacobian.shape[-1]
    )


def numerical(views: BoardViews, T: Array, extra: Array) -> Array:
    """The same by central differences."""

    def residual(step: Array) -> Array:
        moved = se3.retract(T, np.tile(step[:6], (len(T), 1)))
        return views.linearize(moved, extra + step[6:]).residual.ravel()

    steps = STEP * np.eye(6 + len(extra))
    return np.stack([(residual(step) - residual(-step)) / (2 * STEP) for step in steps], axis=-1)


def corners(camera: CameraModel) -> CornerObservations:
    return CornerObservations(
        np.array([0]), np.array([0]), PrintedCorners.from_nominal(CORNERS), np.full((len(CORNERS), 2), 200.0),
        camera, PIXEL, parameters=LocalParameters.exact(1, {}),
    )  # fmt: skip


@pytest.mark.parametrize("pose", [ORDINARY, *UGLY.values()], ids=["ordinary", *UGLY])
@pytest.mark.parametrize(
    "camera", [CAMERA, PLUMB_BOB, RATIONAL, FISHEYE], ids=["plain", "bob", "rational", "fisheye"]
)
def test_derivatives_of_corners_are_the_numerical_ones(camera: CameraModel, pose: Array) -> None:
    views, T = corners(camera), pose[None]
    found = jacobian(views.linearize(T, np.zeros(0)), views)
    expected = numerical(views, T, np.zeros(0))
    assert np.isfinite(expected).all()
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max(), rtol=1e-5)


@pytest.mark.parametrize("bias", [0, 1])
@pytest.mark.parametrize("kind", ["lidar", "laser"])
def test_derivatives_of_ranges_are_the_numerical_ones(kind: str, bias: int) -> None:
    truth = scene((kind,), boards=6, seed=3).truth
    T = relative_poses(truth.T_root_sensor[0], truth.T_root_board)
    views = beams(kind, T, bias)
    # Off the poses that the beams were made for: then their places on the boards matter.
    T, extra = se3.retract(T, np.tile([0.1, -0.2, 0.1, 0.1, -0.1, 0.2], (6, 1))), np.full(bias, 0.03)
    np.testing.assert_allclose(
        jacobian(views.linearize(T, extra), views), numerical(views, T, extra), rtol=1e-5, atol=1e-4
    )


@pytest.mark.parametrize("incidence", [0.0, 80.0, 86.0])
def test_derivatives_of_ranges_at_grazing_incidence_are_the_numerical_ones(incidence: float) -> None:
    n = np.array([-np.cos(np.radians(incidence)), np.sin(np.radians(incidence)), 0.0])
    T = se3.pose(np.column_stack([[0, 0, 1], np.cross(n, [0, 0, 1]), n]), np.array([2.0, 0.0, 0.0]))[None]
    views = one_beam(np.array([1.0, 0.0, 0.0]), 1.9)
    np.testing.assert_allclose(
        jacobian(views.linearize(T, np.zeros(0)), views), numerical(views, T, np.zeros(0)), rtol=1e-5, atol=1e-4
    )


def test_residual_of_a_beam_is_how_much_farther_the_board_is_than_measured() -> None:
    views = one_beam(np.array([1.0, 0.0, 0.0]), 1.9)
    T = se3.pose(np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]), np.array([2.0, 0.3, 0.2]))[None]
    assert views.linearize(T, np.zeros(0)).residual[0, 0] == pytest.approx(0.1 / 0.012)


def test_a_range_bias_is_what_a_scanner_measures_too_much() -> None:
    views = with_range_bias(one_beam(np.array([1.0, 0.0, 0.0]), 2.03))
    T = se3.pose(np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]), np.array([2.0, 0.3, 0.2]))[None]
    assert views.linearize(T, np.array([0.03])).residual[0, 0] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("incidence", [0, 30, 60, 80])
def test_the_noise_of_a_range_grows_with_the_tangent_of_the_incidence(incidence: float) -> None:
    noise, distance = RangeNoise(range=0.01, angle=0.002), 3.0
    n = np.array([-np.cos(np.radians(incidence)), np.sin(np.radians(incidence)), 0.0])
    T = se3.pose(np.column_stack([[0, 0, 1], np.cross(n, [0, 0, 1]), n]), np.array([distance, 0.0, 0.0]))[None]
    rng = np.random.default_rng(0)
    # The beam points off by a little, which changes the range at which it meets the board.
    angle = rng.normal(0, noise.angle, 100_000)
    reach = distance * n[0] / (n[0] * np.cos(angle) + n[1] * np.sin(angle))
    expected = np.std(reach + rng.normal(0, noise.range, len(angle)))
    beam = replace(one_beam(np.array([1.0, 0.0, 0.0]), distance), noise=noise)
    assert beam.update_noise(T, 1.0).sigma[0] == pytest.approx(expected, rel=0.01)


def test_noise_is_stated_noise_times_its_scale() -> None:
    views = one_beam(np.array([1.0, 0.0, 0.0]), 1.9)
    T = se3.pose(np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]), np.array([2.0, 0.3, 0.2]))[None]
    assert views.update_noise(T, 3.0).sigma[0] == pytest.approx(3 * 0.012, rel=1e-3)


@pytest.mark.parametrize("kind", ["camera", "lidar", "laser"])
def test_selected_views_have_the_same_residuals(kind: str) -> None:
    truth = scene((kind,), boards=5).truth
    T = se3.retract(relative_poses(truth.T_root_sensor[0], truth.T_root_board), np.full((5, 6), 0.01))
    views, keep = (
        views_of(kind, relative_poses(truth.T_root_sensor[0], truth.T_root_board)),
        np.array([0, 1, 0, 1, 1], bool),
    )
    linearized, kept = (
        views.linearize(T, np.zeros(0)),
        np.repeat(keep, np.diff(views.start, append=len(views.linearize(T, np.zeros(0)).residual))),
    )
    some = views.select(keep)
    np.testing.assert_array_equal(some.board, [1, 3, 4])
    np.testing.assert_array_equal(some.linearize(T[keep], np.zeros(0)).residual, linearized.residual[kept])


@pytest.mark.parametrize("kind", ["camera", "lidar", "laser"])
def test_no_views_have_no_residuals(kind: str) -> None:
    truth = scene((kind,), boards=5).truth
    views = views_of(kind, relative_poses(truth.T_root_sensor[0], truth.T_root_board)).select(
        np.zeros(5, dtype=bool)
    )
    assert len(views.linearize(np.zeros((0, 4, 4)), np.zeros(0)).residual) == 0


def one_beam(direction: Array, measured: float) -> RangeObservations:
    return RangeObservations(
        np.array([0]), np.array([0]), direction[None], np.array([measured]), RangeNoise(range=0.012, angle=1e-5),
        np.array([0.012]), _MIN_INCIDENCE_COSINE, parameters=LocalParameters.exact(1, {}),
    )  # fmt: skip


def beams(kind: str, T_sensor_board: Array, bias: int) -> RangeObservations:
    views = views_of(kind, T_sensor_board)
    assert isinstance(views, RangeObservations)
    return with_range_bias(views) if bias else views


def test_errors_that_vary_over_the_view_are_differentiated_and_do_not_fit_the_noise_of_ranges() -> None:
    T, noise, rng = ORDINARY[None], DepthNoise(), np.random.default_rng(0)
    directions = np.column_stack([rng.uniform(-0.2, 0.3, (200, 2)), np.ones(200)])
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    n, h = T[0, :3, 2], T[0, :3, 2] @ T[0, :3, 3]
    exact = h / (directions @ n)

    def views(ranges: Array) -> RangeObservations:
        patch = PlanePatch(np.append(n, -h), np.eye(3), ranges, directions, T[0, :3, 3])
        found = RangeObservations.from_detections([0], [patch], noise, _MIN_INCIDENCE_COSINE)
        parameters = replace(LocalParameters.exact(1, {"beams": 6, "bow": 3}), index=np.arange(9)[None], count=9)
        found = replace(found, errors=DepthCameraUncertainty().beam_errors(), parameters=parameters)
        found = replace(found, half_size=np.array([[0.5, 0.4]]), registered=np.array([True]))
        return found.update_noise(T, 1.0)

    extra = np.array([0.01, 0.002, 0.004, 0.002, -0.002, 0.003, 0.001, 0.001, -0.002])
    at = views(exact)
    np.testing.assert_allclose(
        jacobian(at.linearize(T, extra), at)[:, 6:], numerical(at, T, extra)[:, 6:], atol=1e-4, rtol=1e-5
    )
    noisy = views(exact + rng.normal(0.0, 0.01, len(exact)))
    by_errors = [one.linearize(T, extra).jacobian[:, 0, 3:9] * one.sigma[:, None] for one in (at, noisy)]
    np.testing.assert_allclose(by_errors[1], by_errors[0], rtol=1e-9)
