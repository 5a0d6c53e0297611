"""What is handed on for pictures: boards where the solution has them, and how far off every sensor saw them."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.boards.detections import BoardCorners
from calgraph.geometry import Array, se3
from calgraph.result import BoardOutline, BoardView
from calgraph.rig.bundle.solution import RigSolution
from calgraph.rig.checks.assemble import (
    UsedResiduals,
    _subsample_measurements,
    collect_board_outlines,
    collect_board_views,
    measure_fit,
)
from detected_rigs import QUICK, DetectedRig, detect_rig


@pytest.fixture(scope="module")
def one() -> DetectedRig:
    return detect_rig(QUICK)


@pytest.fixture(scope="module")
def joint(one: DetectedRig) -> RigSolution:
    return one.solve()


@pytest.fixture(scope="module")
def used(one: DetectedRig) -> UsedResiduals:
    return {(n, name): {0: [0.0]} for name, by in one.captures.detections.items() for n in by}


@pytest.fixture(scope="module")
def views(one: DetectedRig, used: UsedResiduals, joint: RigSolution) -> tuple[BoardView, ...]:
    return collect_board_views(one.captures, used, joint)


@pytest.fixture(scope="module")
def outlines(one: DetectedRig, used: UsedResiduals, joint: RigSolution) -> tuple[BoardOutline, ...]:
    return collect_board_outlines(one.rig, one.captures, used, joint)


def offs(views: tuple[BoardView, ...], kind: int) -> Array:
    """All that cameras (2) or scanners (1) are off, px or m."""
    return np.concatenate([v.residuals for v in views if v.residuals is not None and v.residuals.ndim == kind])


def test_every_detection_has_a_view(one: DetectedRig, views: tuple[BoardView, ...]) -> None:
    detected = {(n, name) for name, by in one.captures.detections.items() for n in by}
    assert {(v.capture, v.sensor) for v in views} == detected


def test_corners_are_off_by_their_noise(one: DetectedRig, views: tuple[BoardView, ...]) -> None:
    """A board's six unknowns are fitted to 24 numbers, and less than the noise remains."""
    stated = next(iter(one.rig.cameras().values())).noise.pixel
    assert 0.6 * stated < np.sqrt(np.mean(offs(views, 2) ** 2)) < 1.1 * stated


def test_the_fit_of_a_sensor_is_the_rms_of_its_views(
    one: DetectedRig, views: tuple[BoardView, ...], joint: RigSolution
) -> None:
    fit = measure_fit(joint)
    camera = next(iter(one.rig.cameras()))
    errors = np.concatenate([v.residuals for v in views if v.sensor == camera and v.residuals is not None])
    assert (fit[camera].unit, fit[camera].count) == ("px", len(errors))
    np.testing.assert_allclose(fit[camera].rms, np.sqrt(np.mean(np.sum(errors**2, axis=1))))
    points = np.concatenate([v.residuals for v in views if v.sensor == "lidar" and v.residuals is not None])
    assert fit["lidar"].unit == "m"
    # Views are thinned, the fit is not.
    assert fit["lidar"].count >= len(points)
    np.testing.assert_allclose(fit["lidar"].rms, np.sqrt(np.mean(points**2)), rtol=0.05)


def test_an_estimator_without_boards_has_no_fit(joint: RigSolution) -> None:
    assert measure_fit(replace(joint, solved_bundle=None, estimator="hypergraph")) == {}


def test_points_are_off_by_their_noise_on_both_sides(views: tuple[BoardView, ...]) -> None:
    distances = offs(views, 1)
    assert abs(np.mean(distances)) < 0.2 * np.std(distances)
    assert 0.002 < np.std(distances) < 0.03


def test_distances_are_positive_beyond_the_board_as_viewed_from_the_scanner(
    one: DetectedRig, used: UsedResiduals
) -> None:
    """With exact scanners: of others, the estimated errors of ranges are subtracted before."""
    exact = one.without_systematic_errors()
    joint = exact.solve()
    sheets = {
        o.capture: o.corners
        for o in collect_board_outlines(exact.rig, exact.captures, used, joint)
        if o.board is not None
    }
    views = collect_board_views(exact.captures, used, joint)
    compared = [v for v in views if v.capture in sheets and v.residuals is not None and v.residuals.ndim == 1]
    assert len(compared) > 20
    for view in compared:
        assert view.residuals is not None
        T, corners = joint.T_root_sensor[view.sensor], sheets[view.capture]
        normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
        normal *= np.sign(normal @ (corners[0] - T[:3, 3])) / np.linalg.norm(normal)
        distances = (se3.apply(T, view.measured) - corners[0]) @ normal
        # Residuals are without the systematic errors of ranges, which are estimated.
        np.testing.assert_allclose(view.residuals, distances, atol=0.005)


def test_sheets_are_where_the_board_was(one: DetectedRig, outlines: tuple[BoardOutline, ...]) -> None:
    """Wherever a camera saw it, corner by corner."""
    pictured = [o for o in outlines if o.board is not None]
    assert len(pictured) > 10
    half = np.array(one.rig.board_size) / 2
    sheet = np.column_stack([half * [[-1, -1], [1, -1], [1, 1], [-1, 1]], np.zeros(4)])
    for outline in pictured:
        truth = se3.apply(one.truth.boards[outline.capture].T_root_board, sheet)
        assert np.linalg.norm(outline.corners - truth, axis=1).max() < 0.02


def test_boards_that_no_camera_detected_have_the_rectangle_of_the_scanners_points(
    one: DetectedRig, used: UsedResiduals, joint: RigSolution
) -> None:
    """In the board's plane, with its centre and about its area; its axes are those of the points."""
    of_lidar = {view: found for view, found in used.items() if view[1] == "lidar"}
    other = replace(joint, solved_bundle=None, estimator="hypergraph")
    pictured = [o for o in collect_board_outlines(one.rig, one.captures, of_lidar, other) if o.board is None]
    assert len(pictured) > 10
    area = np.prod(one.rig.board_size)
    for outline in pictured:
        corners = se3.apply(se3.inverse(one.truth.boards[outline.capture].T_root_board), outline.corners)
        np.testing.assert_allclose(corners[:, 2], 0, atol=0.05)
        np.testing.assert_allclose(corners.mean(axis=0), 0, atol=0.15)
        along, across = corners[1] - corners[0], corners[3] - corners[0]
        np.testing.assert_allclose(corners[2], corners[0] + along + across, atol=1e-9)
        assert along @ across == pytest.approx(0, abs=1e-9)
        assert 0.6 * area < np.linalg.norm(along) * np.linalg.norm(across) < 1.4 * area


def test_without_a_bundle_nothing_is_predicted(one: DetectedRig, used: UsedResiduals, joint: RigSolution) -> None:
    other = replace(joint, solved_bundle=None, estimator="hypergraph")
    views = collect_board_views(one.captures, used, other)
    assert all(v.used and v.residuals is None for v in views)
    outlines = collect_board_outlines(one.rig, one.captures, used, other)
    seen_by_cameras = {
        n for by in one.captures.detections.values() for n, d in by.items() if isinstance(d[0], BoardCorners)
    }
    assert {o.capture for o in outlines if o.board == 0} == seen_by_cameras


@pytest.mark.parametrize(("count", "kept"), [(1, 1), (299, 299), (300, 150), (601, 201)])
def test_measurements_are_thinned_to_at_most_300(count: int, kept: int) -> None:
    pixels = np.zeros((count, 2))
    pixels[:, 0] = np.arange(count)
    detection = BoardCorners(
        np.zeros((count, 3)), pixels, np.eye(4), np.eye(6), np.array([0.0, 0, 1, 1]), np.eye(3), 0.1
    )
    thinned = _subsample_measurements(detection)
    np.testing.assert_array_equal(thinned[:, 0], np.arange(0, count, -(-count // kept)))
