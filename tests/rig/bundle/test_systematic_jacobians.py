"""Derivatives by all systematic parameters against finite differences, and rings against dense one-hot columns."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from calgraph.config import Intrinsics, Rig
from calgraph.geometry import Array, se3
from calgraph.graph.pairwise_estimate import select_matches
from calgraph.rig.bundle.board_observations import group_detections
from calgraph.rig.bundle.board_outlines import add_outlines
from calgraph.rig.bundle.bundle_setup import build_bundle, update_noise
from calgraph.rig.bundle.bundle_solver import (
    BOARD_PRIOR_INFORMATION,
    HUBER_THRESHOLD,
    Bundle,
    BundleState,
    linearize_bundle,
)
from calgraph.rig.bundle.covariances import sum_information
from calgraph.rig.bundle.normal_equations import accumulate
from calgraph.rig.bundle.observations import BoardViews, LinearizedResiduals, relative_poses, view_indices
from calgraph.rig.bundle.range_observations import RangeObservations
from calgraph.rig.bundle.systematic_parameters import _MAX_RINGS, find_rings
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.checks.cross_validation import view_jacobians
from calgraph.sensors import CameraModel
from calgraph.simulation import CameraOptions, LaserOptions, MultibeamOptions
from detected_rigs import QUICK, detect_rig

DENSE = QUICK.model_copy(
    update={
        "laser": LaserOptions(count=1, resolution=0.5),
        "multibeam": MultibeamOptions(count=1, resolution=0.5),
        "radii": (1.5, 2.2),
    }
)
FISHEYE = CameraOptions(model="fisheye", width=640, height=480, distortion=(0.02, -0.01, 0.0, 0.0))
SCENARIOS = {"pinhole": DENSE, "fisheye": DENSE.model_copy(update={"camera": FISHEYE})}


def displace_beyond_model(rig: Rig, cameras: Mapping[str, CameraModel]) -> Rig:
    """The rig with cameras whose lenses displace pixels beyond their models."""
    stated = {
        name: rig.cameras()[name].model_copy(
            update={"intrinsics": Intrinsics.from_camera(camera, model_error=1.0)}
        )
        for name, camera in cameras.items()
    }
    return rig.model_copy(update={"sensors": {**rig.sensors, **stated}})


# Of boards before all sensors, m/s and rad/s.
TWIST = np.array([0.3, -0.2, 0.4, 0.05, 0.1, -0.05])


@pytest.fixture(scope="module", params=[("pinhole", False), ("fisheye", False), ("pinhole", True)])
def bundle_and_state(request: pytest.FixtureRequest) -> tuple[Bundle, BundleState]:
    """Of all sensors and outlines, at rest and in motion, with parameters half a prior standard deviation off."""
    scenario, moving = request.param
    one = detect_rig(SCENARIOS[scenario])
    boards = group_detections([(pair, select_matches(pair, "ransac")) for pair in one.pairs()])
    captures = move(one.captures) if moving else one.captures
    rig = displace_beyond_model(one.rig, captures.cameras)
    bundle, state = build_bundle(rig, captures, boards, one.T_root_sensor)
    bundle, state = add_outlines(bundle, state, one.rig, one.captures.detections, boards, 1e-6)
    rng = np.random.default_rng(0)
    prior = [parameter.prior_stddev for parameter in bundle.extra_parameters]
    # Places of beams on bowed boards belong to the poses.
    bundle = update_noise(bundle, state)
    return bundle, replace(state, extra=0.5 * rng.normal(size=len(prior)) * prior)


def move(captures: CaptureSet) -> CaptureSet:
    """Boards with a velocity."""
    moving = {
        name: {capture: tuple(replace(one, twist=TWIST) for one in found) for capture, found in by_capture.items()}
        for name, by_capture in captures.detections.items()
    }
    return replace(captures, detections=moving)


def dense_jacobian(linearized: LinearizedResiduals, start: np.ndarray) -> Array:
    """(N, k, 6 + e) by the pose of each measurement's view and the extra parameters."""
    N, k, q = linearized.jacobian.shape
    by_local = np.zeros((N, k, linearized.local_jacobian.shape[1]))
    by_local[..., :q] = linearized.jacobian
    if linearized.ring is not None:
        by_local[np.arange(N), :, q + linearized.ring] = linearized.jacobian[..., linearized.ring_column]
    return np.asarray(by_local @ linearized.local_jacobian[view_indices(start, N)])


def poses_and_extra(bundle: Bundle, state: BundleState, k: int) -> tuple[Array, Array]:
    """Poses before the sensor of views k, off those that the measurements were made for, and its parameters."""
    views = bundle.all_views[k]
    T = relative_poses(state.T_root_sensor[bundle.sensor_of(k)], state.T_root_board[views.board])
    off = np.random.default_rng(k).normal(size=(len(T), 6)) * [0.005] * 3
    return se3.retract(T, off), state.extra[bundle.extra_indices(k)]


@pytest.mark.parametrize("k", range(5))
def test_derivatives_by_poses_and_systematic_parameters(
    bundle_and_state: tuple[Bundle, BundleState], k: int
) -> None:
    """The share of a bow in the derivative by the plane is neglected: 0.002 of it."""
    bundle, state = bundle_and_state
    views = bundle.all_views[k]
    T, extra = poses_and_extra(bundle, state, k)
    linearized = views.linearize(T, extra)
    found = dense_jacobian(linearized, views.start)
    steps = np.concatenate([
        np.full(6, 1e-6), [1e-4 * bundle.extra_parameters[i].prior_stddev for i in bundle.extra_indices(k)]
    ])  # fmt: skip

    def residual(column: int, step: float) -> Array:
        by = np.zeros(6 + len(extra))
        by[column] = step
        return views.linearize(se3.retract(T, np.tile(by[:6], (len(T), 1))), extra + by[6:]).residual

    for column, step in enumerate(steps):
        expected = (residual(column, step) - residual(column, -step)) / (2 * step)
        size = np.abs(expected).max()
        # No edges are between rings.
        assert (
            size > 0
            or bundle.extra_parameters[bundle.extra_indices(k)[column - 6]].quantity == "elevation footprint"
        )
        np.testing.assert_allclose(found[..., column], expected, atol=2e-3 * size)


def test_all_kinds_of_parameters_are_differentiated(bundle_and_state: tuple[Bundle, BundleState]) -> None:
    bundle, _ = bundle_and_state
    moving = any(len(views.twist) for views in bundle.views)
    quantities = {one.quantity.split(" of ring")[0] for one in bundle.extra_parameters}
    assert quantities >= {
        "focal length", "pixel aspect", "cx", "cy", "k1", "k2", "range bias", "range scale", "angle scale", "bias",
        "print scale", "print aspect", "tag size", "bow along x", "bow along y", "twist", "x", "y", "rotation",
        "width", "height", "print x", "print y", "print rotation", "azimuth footprint", "elevation footprint",
    } | ({"stamp delay", "readout time"} if moving else set())  # fmt: skip
    delayed = [one.of for one in bundle.extra_parameters if one.quantity == "stamp delay"]
    assert delayed == (list(bundle.sensors[1:]) if moving else [])


def test_local_parameters_change_as_their_derivatives_state(bundle_and_state: tuple[Bundle, BundleState]) -> None:
    """Differences of local parameters for small steps of poses and parameters, of each kind of views."""
    bundle, state = bundle_and_state
    for k, views in enumerate(bundle.all_views):
        T, extra = poses_and_extra(bundle, state, k)
        rng = np.random.default_rng(k)
        pose_step, extra_step = 1e-6 * rng.normal(size=(len(T), 6)), 1e-6 * rng.normal(size=len(extra))
        J = views.local_jacobian(T)
        expected = (J[..., :6] @ pose_step[..., None])[..., 0] + J[..., 6:] @ extra_step
        found = views.local_difference(T, se3.retract(T, pose_step), extra_step)
        np.testing.assert_allclose(found, expected, atol=1e-10)


def test_sums_of_rings_are_those_of_dense_columns(bundle_and_state: tuple[Bundle, BundleState]) -> None:
    bundle, state = bundle_and_state
    k = bundle.sensors.index("lidar")
    views = bundle.views[k]
    assert views.parameters.ring_count > 5
    T, extra = poses_and_extra(bundle, state, k)
    # Also with outliers that are down-weighted: one in ten beams is far off.
    assert isinstance(views, RangeObservations)
    far = replace(views, ranges=views.ranges + 0.2 * (np.arange(len(views.ranges)) % 10 == 0))
    for some in (views, far):
        linearized = some.linearize(T, extra)
        dense = one_hot(linearized)
        grouped, single = (
            accumulate(one, some.start, HUBER_THRESHOLD, lambda e: 0 * e.Jtr) for one in (linearized, dense)
        )
        scale = np.sqrt(np.maximum(np.diagonal(single.JtJ, axis1=-2, axis2=-1), 1.0))
        np.testing.assert_allclose(
            grouped.JtJ / scale[:, None] / scale[..., None],
            single.JtJ / scale[:, None] / scale[..., None],
            atol=1e-9,
        )
        np.testing.assert_allclose(grouped.Jtr / scale, single.Jtr / scale, atol=1e-7)
        np.testing.assert_allclose(grouped.squared_residuals, single.squared_residuals)
        np.testing.assert_allclose(grouped.robust_cost_offset, single.robust_cost_offset)


def test_the_covariance_is_the_inverse_of_the_dense_information(
    bundle_and_state: tuple[Bundle, BundleState], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of poses, systematic parameters, rings and footprints, with their priors; without view biases."""
    monkeypatch.setattr("calgraph.rig.bundle.bundle_solver.HUBER_THRESHOLD", 1e6)
    monkeypatch.setattr("calgraph.rig.bundle.variance_components.HUBER_THRESHOLD", 1e6)
    bundle, state = bundle_and_state
    bundle = replace(bundle, bias_variance=np.zeros_like(bundle.bias_variance))
    G, boards = bundle.parameter_count, len(state.T_root_board)
    H = np.diag(np.concatenate([bundle.prior_stddev**-2, np.full(6 * boards, BOARD_PRIOR_INFORMATION)]))
    for k, views in enumerate(bundle.all_views):
        T = relative_poses(state.T_root_sensor[bundle.sensor_of(k)], state.T_root_board[views.board])
        linearized = views.linearize(T, state.extra[bundle.extra_indices(k)])
        by_view, view = (
            dense_jacobian(linearized, views.start),
            view_indices(views.start, len(linearized.residual)),
        )
        J_sensor, J_board = view_jacobians(linearize_bundle(bundle, state).views[k])
        for v, board in enumerate(views.board):
            J = by_view[view == v].reshape(-1, by_view.shape[-1])
            J = np.concatenate([J @ J_sensor[v], J @ J_board[v]], axis=1)
            columns = np.concatenate([bundle.columns(k), G + 6 * board + np.arange(6)])
            H[np.ix_(columns, columns)] += J.T @ J
    expected = np.linalg.inv(H)[:G, :G]
    found = linearize_bundle(bundle, state).covariance
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / size / size[:, None], expected / size / size[:, None], atol=1e-5)


def test_information_of_boards_and_priors_is_that_of_the_problem_with_these_boards(
    bundle_and_state: tuple[Bundle, BundleState],
) -> None:
    bundle, state = bundle_and_state
    count = len(state.T_root_board)
    prior = np.diag(bundle.prior_weights(state.extra) * bundle.prior_stddev**-2)
    weights = np.array([np.ones(count), np.arange(count) < count / 2])
    found = sum_information(bundle, linearize_bundle(bundle, state), weights)
    for information, some in zip(found, weights > 0, strict=True):
        with_these = bundle.with_views([views.select(some[views.board]) for views in bundle.all_views])
        expected, _, _ = linearize_bundle(with_these, state).eliminate_boards()
        size = np.sqrt(np.diag(expected))
        unit = np.outer(size, size)
        np.testing.assert_allclose((information + prior) / unit, expected / unit, atol=1e-5)


def one_hot(linearized: LinearizedResiduals) -> LinearizedResiduals:
    """The same with a column for each ring."""
    assert linearized.ring is not None
    N, k, _ = linearized.jacobian.shape
    rings = np.zeros((N, k, linearized.ring_count))
    rings[np.arange(N), :, linearized.ring] = linearized.jacobian[..., linearized.ring_column]
    return replace(linearized, jacobian=np.concatenate([linearized.jacobian, rings], axis=-1), ring=None)


def beams(elevation_degrees: Array, azimuths: int = 40) -> Array:
    """(N, 3) directions of all combinations, in an order without any meaning."""
    elevation, azimuth = np.meshgrid(np.radians(elevation_degrees), np.linspace(-0.5, 0.5, azimuths))
    e, a = (np.random.default_rng(0).permutation(one.ravel()) for one in (elevation, azimuth))
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)


def test_rings_are_found_by_gaps_between_elevations() -> None:
    stated = np.arange(-15.0, 16.0, 2.0)
    directions = beams(stated)
    elevations, ring = find_rings(directions)
    np.testing.assert_allclose(np.degrees(elevations), stated, atol=1e-9)
    np.testing.assert_allclose(np.degrees(np.arcsin(directions[:, 2])), stated[ring], atol=1e-9)


def test_elevations_of_a_ring_may_differ_slightly() -> None:
    """As of drivers that correct them by azimuth, by 0.02°."""
    stated = np.arange(-15.0, 16.0, 2.0)
    directions = beams((stated[:, None] + np.linspace(-0.01, 0.01, 5)).ravel())
    elevations, ring = find_rings(directions)
    np.testing.assert_allclose(np.degrees(elevations), stated, atol=0.01)
    assert np.abs(np.degrees(np.arcsin(directions[:, 2])) - stated[ring]).max() < 0.02


def test_a_scanner_without_gaps_has_no_rings() -> None:
    """As solid-state LiDARs, and spinning 2-D scanners."""
    elevations, ring = find_rings(beams(np.linspace(-12, 12, 1000)))
    assert len(elevations) == 0
    assert not ring.any()
    no_beams = find_rings(np.zeros((0, 3)))
    assert [len(one) for one in no_beams] == [0, 0]


@pytest.mark.parametrize("count", [64, 100, 128])
def test_neighbours_of_many_rings_share_a_bias(count: int) -> None:
    stated = np.linspace(-22.5, 22.5, count)
    directions = beams(stated)
    elevations, ring = find_rings(directions)
    assert len(elevations) == _MAX_RINGS
    assert np.all(np.diff(elevations) > 0)
    # Equally many, up to one, of contiguous elevations.
    elevation = np.degrees(np.arcsin(directions[:, 2]))
    of_stated = np.array([np.unique(ring[np.abs(elevation - one) < 1e-6]) for one in stated]).ravel()
    assert len(of_stated) == count
    assert np.all(np.diff(of_stated) >= 0)
    assert np.ptp(np.bincount(of_stated)) <= 1


def test_beams_elsewhere_belong_to_the_nearest_ring(bundle_and_state: tuple[Bundle, BundleState]) -> None:
    bundle, _ = bundle_and_state
    views = bundle.views[bundle.sensors.index("lidar")]
    assert isinstance(views, RangeObservations)
    assert views.ring is not None
    chosen = np.sort(np.random.default_rng(0).permutation(len(views.ranges))[:30])
    found = views.with_beams(np.array([0]), np.array([0]), views.directions[chosen], views.ranges[chosen])
    assert found.ring is not None
    order = np.argsort(views.ring[chosen], kind="stable")
    np.testing.assert_array_equal(found.ring, views.ring[chosen][order])
    np.testing.assert_array_equal(found.ranges, views.ranges[chosen][order])


def views_without(views: BoardViews) -> BoardViews:
    return views.select(np.zeros(len(views.board), dtype=np.bool_))


def test_no_views_have_no_residuals(bundle_and_state: tuple[Bundle, BundleState]) -> None:
    bundle, state = bundle_and_state
    for k, views in enumerate(bundle.all_views):
        extra = state.extra[bundle.extra_indices(k)]
        linearized = views_without(views).linearize(np.zeros((0, 4, 4)), extra)
        assert len(linearized.residual) == 0
        q = views.local_jacobian(np.zeros((len(views.board), 4, 4)) + np.eye(4)).shape[1]
        assert linearized.local_jacobian.shape == (0, q, 6 + len(extra))
