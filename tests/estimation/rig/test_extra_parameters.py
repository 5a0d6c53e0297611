"""Range biases, intrinsics and tags' places: recovered from simulated detections; poses are right with them."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.config import Board, Checkerboard
from calgraph.config.settings import ExtraParameterSettings
from calgraph.detection import BoardCorners, Detection
from calgraph.errors import InputError
from calgraph.estimation import Estimable, RigSolution
from calgraph.estimation.rig.extra_parameters import _intrinsic_parameters
from calgraph.result import EstimatedParameter
from calgraph.sensors import CameraModel
from calgraph.simulation import CameraOptions
from detected_rigs import QUICK, DetectedRig, detect_rig

# How far the board's first tag is printed off its stated place, m.
SHIFT = np.array([0.003, 0.0, 0.0])


@pytest.fixture(scope="module")
def right() -> DetectedRig:
    return detect_rig()


@pytest.fixture(scope="module")
def biased(right: DetectedRig) -> DetectedRig:
    """The 2-D scanner measures 30 mm too much."""

    def longer(name: str, detection: Detection) -> Detection:
        if name != "laser_front" or isinstance(detection, BoardCorners):
            return detection
        return replace(detection, ranges=detection.ranges + 0.03)

    return right.map_detections(longer)


@pytest.fixture(scope="module")
def misfocused(right: DetectedRig) -> DetectedRig:
    """The camera's focal length is stated 1 % too large."""
    camera = right.captures.cameras["camera"]
    wrong = camera.with_intrinsics(camera.intrinsics * [1.01, 1.01, *[1.0] * 6])
    return replace(right, captures=replace(right.captures, cameras={"camera": wrong}))


@pytest.fixture(scope="module")
def misprinted(right: DetectedRig) -> DetectedRig:
    """The first tag is stated 3 mm off where it is."""
    (board,) = right.rig.boards
    first, *others = board.tags
    x, y = first.center
    stated = first.model_copy(update={"center": (x + SHIFT[0], y + SHIFT[1])})
    target = board.model_copy(update={"tags": (stated, *others)})

    def moved(_: str, detection: Detection) -> Detection:
        if not isinstance(detection, BoardCorners):
            return detection
        on_first = np.all(np.abs(detection.corners_board[:, :2] - first.center) < 0.6 * first.size, axis=1)
        return replace(detection, corners_board=detection.corners_board + on_first[:, None] * SHIFT)

    rig = right.rig.model_copy(update={"target": target})
    return replace(right.map_detections(moved), rig=rig)


def one(joint: RigSolution, of: str, quantity: str) -> EstimatedParameter:
    (found,) = [e for e in joint.extra_parameters if (e.of, e.quantity) == (of, quantity)]
    return found


def test_range_bias_is_recovered(biased: DetectedRig) -> None:
    bias = one(biased.solve("range_bias"), "laser_front", "range bias")
    assert abs(bias.value - 0.03) < 3 * bias.stddev
    assert bias.stddev < 0.005


def test_range_bias_of_an_unbiased_scanner_is_zero(biased: DetectedRig) -> None:
    bias = one(biased.solve("range_bias"), "lidar", "range bias")
    assert abs(bias.value) < 3 * bias.stddev


def test_a_biased_scanner_is_placed_right_if_its_bias_is_estimated(biased: DetectedRig) -> None:
    assert biased.mahalanobis(biased.solve("range_bias"), "laser_front") < 3
    assert biased.error(biased.solve(), "laser_front") > 0.01


def test_focal_length_is_recovered(misfocused: DetectedRig, right: DetectedRig) -> None:
    joint, truth = misfocused.solve("intrinsics"), right.captures.cameras["camera"]
    for found, true in zip(joint.extra_parameters, truth.intrinsics, strict=True):
        assert abs(found.value - true) < 3.5 * found.stddev
    assert one(joint, "camera", "fx").stddev < 0.003 * truth.focal[0]


def test_a_misfocused_camera_is_placed_right_if_its_intrinsics_are_estimated(misfocused: DetectedRig) -> None:
    assert misfocused.mahalanobis(misfocused.solve("intrinsics"), "camera") < 3
    assert misfocused.error(misfocused.solve(), "camera") > 0.01


def test_displacement_of_a_tag_is_recovered(misprinted: DetectedRig) -> None:
    joint = misprinted.solve("tags")
    # What is stated too far to the right is found as much to the left; one tag is where it is by definition.
    (free,) = [e for e in joint.extra_parameters if (e.of, e.quantity) == ("tag 0", "x")]
    assert abs(free.value + 0.003) < 3 * free.stddev
    assert free.stddev < 0.001


def test_a_camera_is_placed_right_if_the_misprint_is_estimated(misprinted: DetectedRig) -> None:
    with_it, without = misprinted.solve("tags"), misprinted.solve()
    assert misprinted.mahalanobis(with_it, "camera") < 3
    assert misprinted.mahalanobis(without, "camera") > 4


def test_correct_values_are_recovered_if_all_are_estimated(right: DetectedRig) -> None:
    joint = right.solve("tags", "range_bias", "intrinsics")
    stated = np.array([e.stated for e in joint.extra_parameters])
    z = (np.array([e.value for e in joint.extra_parameters]) - stated) / [e.stddev for e in joint.extra_parameters]
    assert np.abs(z).max() < 4
    assert right.mahalanobis(joint, "camera") < 3


def test_variances_grow_with_more_parameters(right: DetectedRig) -> None:
    fewer, more = right.solve().covariance["camera"], right.solve("intrinsics").covariance["camera"]
    assert np.all(np.diag(more) > np.diag(fewer))


def test_parameters_that_are_not_observable_are_reported(
    right: DetectedRig, caplog: pytest.LogCaptureFixture
) -> None:
    camera = right.captures.cameras["camera"]
    # Those above and those below the line of a rational polynomial do nearly the same.
    rational = replace(camera, distortion=np.array([*camera.distortion, 0.0, 0.0, 0.0, 0.0]))
    joint = replace(right, captures=replace(right.captures, cameras={"camera": rational})).solve("intrinsics")
    assert not one(joint, "camera", "k1").measured
    assert "k1 of camera is not observable from these captures" in caplog.text
    assert one(joint, "camera", "fx").measured


@pytest.mark.parametrize(("estimate", "lack"), [("intrinsics", "no camera"), ("tags", "no camera")])
def test_parameters_that_no_sensor_has_are_refused(estimate: Estimable, lack: str) -> None:
    blind = detect_rig(QUICK.model_copy(update={"camera": CameraOptions(count=0)}))
    with pytest.raises(InputError, match=lack):
        blind.solve(estimate)


def test_boards_without_tags_have_none_to_estimate() -> None:
    pattern = Checkerboard(kind="checkerboard", columns=7, rows=5, square=0.12)
    chess = detect_rig(QUICK.model_copy(update={"board": Board(size=(1.2, 0.9), pattern=pattern)}))
    with pytest.raises(InputError, match="two tags"):
        chess.solve("tags")


def test_focal_lengths_and_principal_points_are_in_pixels_and_distortion_has_no_unit() -> None:
    """600 by 400 pixels, and standard deviations of 1 % of the focal lengths and 2 % of the size of the image."""
    K = np.array([[500.0, 0, 300], [0, 510, 200], [0, 0, 1]])
    camera = CameraModel("pinhole", 600, 400, K, np.array([0.1, 0.2, 0.3, 0.4]))
    settings = ExtraParameterSettings(focal_length=0.01, principal_point=0.02, distortion=0.05)
    found = [
        (one.quantity, one.unit, one.prior_value, one.prior_stddev)
        for one in _intrinsic_parameters("camera", 1, camera, settings)
    ]
    assert found == [
        ("fx", "px", 500.0, 5.0), ("fy", "px", 510.0, pytest.approx(5.1)), ("cx", "px", 300.0, 12.0),
        ("cy", "px", 200.0, 8.0), ("k1", "", 0.1, 0.05), ("k2", "", 0.2, 0.05), ("p1", "", 0.3, 0.05),
        ("p2", "", 0.4, 0.05),
    ]  # fmt: skip
