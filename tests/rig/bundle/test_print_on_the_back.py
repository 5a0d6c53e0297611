"""A board with a print on either side: its thickness, and that the prints do not coincide, are estimated."""

import numpy as np
import pytest

from calgraph.boards.camera import CameraDetector
from calgraph.config import PixelNoise, Rig
from calgraph.config.settings import CameraDetectionSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3
from calgraph.rig.bundle.board_observations import BoardObservation
from calgraph.rig.bundle.bundle_setup import build_bundle
from calgraph.rig.bundle.corner_observations import CornerObservations
from calgraph.rig.bundle.observations import relative_poses
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.captures.from_detections import captures_from_detections
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import calibrate_detections
from calgraph.sensors import CameraModel, DetectedCorners

SQUARE, COLUMNS, ROWS = 0.06, 7, 5
CAMERA = CameraModel("pinhole", 1280, 960, np.array([[900, 0, 639.5], [0, 900, 479.5], [0, 0, 1.0]]), np.zeros(0))
CAMERA_OPTIONS = {
    "kind": "camera",
    "intrinsics": {"model": "pinhole", "width": 1280, "height": 960, "K": [900, 900, 639.5, 479.5]},
}
RIG = Rig.model_validate({
    "root": "front",
    "target": {
        "kind": "board",
        "size": [SQUARE * COLUMNS, SQUARE * ROWS],
        "pattern": {"kind": "charuco", "columns": COLUMNS, "rows": ROWS, "square": SQUARE, "marker": 0.045,
                    "dictionary": "DICT_4X4_50"},
    },
    "sensors": {name: {**CAMERA_OPTIONS, "topic": f"/{name}"} for name in ("front", "back")},
})  # fmt: skip
THICKNESS, OFFSET = 0.006, np.array([0.003, -0.002])
# The cameras look at each other from 3 m.
T_FRONT_BACK = se3.pose(np.diag([-1.0, 1.0, -1.0]), np.array([0.1, 0.0, 3.0]))


def printed_corners() -> Array:
    """Inner corners (N, 3) in the board frame, m."""
    x = (np.arange(1, COLUMNS) - COLUMNS / 2) * SQUARE
    y = (ROWS / 2 - np.arange(1, ROWS)) * SQUARE
    return np.array([[a, b, 0.0] for b in y for a in x])


def capture(rng: np.random.Generator, captures: int = 30) -> CaptureSet:
    """Both cameras' corners of boards between them, with a noise of 0.2 px."""
    detector = CameraDetector(RIG.boards, CAMERA, PixelNoise(pixel=0.2), CameraDetectionSettings())
    facing = se3.pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 1.5]))
    corners = printed_corners()
    behind = corners + np.append(OFFSET, -THICKNESS)
    # OpenCV's frame of the message: x right, y down, from the top left.
    stated = (corners - [-SQUARE * COLUMNS / 2, SQUARE * ROWS / 2, 0]) * [1, -1, 1]
    found: dict[str, dict[int, object]] = {"front": {}, "back": {}}
    for k in range(captures):
        T = se3.retract(facing, rng.normal(size=6) * [0.25, 0.2, 0.2, 0.4, 0.4, 0.3])
        for name, T_camera, points in (("front", np.eye(4), corners), ("back", se3.inverse(T_FRONT_BACK), behind)):
            pixels = CAMERA.project(se3.apply(T_camera @ T, points)) + 0.2 * rng.normal(size=(len(points), 2))
            inside = CAMERA.contains(pixels)
            if inside.sum() < 8:
                continue
            result = detector.find([DetectedCorners(0.0, "", stated[inside], pixels[inside])])
            if not isinstance(result, Rejected):
                found[name][k] = result
    return captures_from_detections(RIG, found)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def captures() -> CaptureSet:
    return capture(np.random.default_rng(0))


def test_thickness_and_place_of_the_print_on_the_back_are_estimated(captures: CaptureSet) -> None:
    found = calibrate_detections(RIG, captures.detections, RigOptions())
    values = {one.quantity: one for one in found.systematic if one.of == "board"}
    for quantity, truth in (("thickness", THICKNESS), ("print on the back x", OFFSET[0]),
                            ("print on the back y", OFFSET[1])):  # fmt: skip
        assert values[quantity].stddev < 0.001
        assert abs(values[quantity].value - truth) < 3 * values[quantity].stddev
    back = found["back"]
    error = se3.difference(back.T_root_sensor, T_FRONT_BACK)
    assert np.linalg.norm(error[:3]) < 0.015
    assert error @ np.linalg.solve(back.covariance, error) / 6 < 3


def test_cameras_before_the_board_have_no_such_parameters(captures: CaptureSet) -> None:
    observed = [BoardObservation(k, {"front": 0, "back": 0}) for k in captures.detections["back"]
                if k in captures.detections["front"]]  # fmt: skip
    bundle, state = build_bundle(RIG, captures, observed, {"front": np.eye(4), "back": T_FRONT_BACK})
    of_sets = {one.quantity: one.view_sets for one in bundle.extra_parameters}
    assert of_sets["print scale"] == (0, 1)
    assert of_sets["thickness"] == of_sets["print on the back rotation"] == (1,)
    views = bundle.views[1]
    assert isinstance(views, CornerObservations)
    extra = 0.5 * np.array([bundle.extra_parameters[i].prior_stddev for i in bundle.extra_indices(1)])
    T = relative_poses(state.T_root_sensor[1], state.T_root_board)
    at = views.linearize(T, extra)
    by_extra = (at.jacobian @ at.local_jacobian[np.repeat(np.arange(len(T)), np.diff(
        views.start, append=len(views.pixels)))])[..., 6:]  # fmt: skip
    for column, i in enumerate(bundle.extra_indices(1)):
        step = 1e-4 * bundle.extra_parameters[i].prior_stddev * np.eye(len(extra))[column]
        expected = (views.linearize(T, extra + step).residual - views.linearize(T, extra - step).residual) / (
            2 * step[column]
        )
        np.testing.assert_allclose(by_extra[..., column], expected, atol=1e-3 * np.abs(expected).max())
