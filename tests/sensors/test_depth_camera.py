"""Depth images as clouds, and how the noise and the errors of depths grow."""

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.sensors import CameraModel, Image
from calgraph.sensors.kinds import KINDS, DepthCameraUncertainty, DepthNoise, recognize_kind
from calgraph.sensors.kinds.depth_camera import convert_depth_image

AZURE_KINECT = (0.5, -2.7, 4e-4, -2e-5, 1.5, 0.4, -2.5, 1.5)


def lens(width: int = 320, height: int = 240, distortion: tuple[float, ...] = ()) -> CameraModel:
    K = np.array([[0.8 * width, 0, width / 2 - 0.5], [0, 0.8 * width, height / 2 - 0.5], [0, 0, 1]])
    return CameraModel("pinhole", width, height, K, np.array(distortion))


def depth_image(depth: Array) -> Image:
    return Image(7.5, "depth_optical", np.zeros(depth.shape, np.uint8), depth.astype(np.float32))


def test_depths_are_along_the_optical_axis_and_not_along_the_beams() -> None:
    cloud = convert_depth_image(depth_image(np.full((240, 320), 2.0)), lens())
    np.testing.assert_allclose(cloud.points[:, 2], 2.0, rtol=1e-6)
    assert np.linalg.norm(cloud.points, axis=1).max() > 2.5
    assert (cloud.stamp, cloud.frame_id, cloud.rings, cloud.times) == (7.5, "depth_optical", None, None)


@pytest.mark.parametrize("distortion", [(), (0.1, -0.05, 1e-3, -1e-3, 0.0), AZURE_KINECT])
def test_points_project_to_the_pixels_that_measured_them(distortion: tuple[float, ...]) -> None:
    camera = lens(distortion=distortion)
    depth = np.random.default_rng(0).uniform(0.5, 4.0, (240, 320))
    cloud = convert_depth_image(depth_image(depth), camera)
    pixels = camera.project(cloud.points)
    column, row = np.round(pixels).astype(int).T
    np.testing.assert_allclose(pixels, np.column_stack([column, row]), atol=1e-6)
    np.testing.assert_allclose(cloud.points[:, 2], depth[row, column], rtol=1e-6)


def test_one_pixel_of_each_matching_window_is_kept_and_none_without_a_depth() -> None:
    depth = np.full((480, 640), 1.5)
    assert len(convert_depth_image(depth_image(depth), lens(640, 480)).points) == 107 * 80
    depth[:, :320] = np.nan
    assert convert_depth_image(depth_image(depth), lens(640, 480)).points[:, 0].min() > 0


def test_images_of_another_size_or_without_depths_are_refused() -> None:
    with pytest.raises(ValueError, match="has 640 x 480 pixels, its intrinsics are of 320 x 240"):
        convert_depth_image(depth_image(np.ones((480, 640))), lens())
    with pytest.raises(ValueError, match="16UC1"):
        convert_depth_image(Image(0.0, "", np.zeros((240, 320), np.uint8)), lens())


def test_an_image_with_depths_is_of_a_depth_camera_and_others_are_of_a_camera() -> None:
    plain = Image(0.0, "", np.zeros((240, 320), np.uint8))
    assert recognize_kind("sensor_msgs/msg/Image", plain) == "camera"
    assert recognize_kind("sensor_msgs/msg/Image", depth_image(np.ones((240, 320)))) == "depth_camera"
    assert KINDS["depth_camera"].axes == KINDS["camera"].axes


def test_noise_grows_with_the_square_of_the_depth_and_has_a_floor() -> None:
    noise = DepthNoise(range=0.003)
    np.testing.assert_allclose(noise.at(np.array([0.3, 1.0, 2.0, 4.0])), [0.001, 0.003, 0.012, 0.048])
    oblique = np.array([[0.6, 0.0, 0.8]])
    # The pixel has a depth of 2 m; along its beam the error is longer by the cosine.
    np.testing.assert_allclose(noise.of_beams(np.array([2.5]), oblique), 0.012 / 0.8)


def test_each_shape_of_errors_has_its_prior() -> None:
    _, _, *errors = DepthCameraUncertainty(depth_bias=0.004, depth_warp=0.002).beam_errors()
    assert [one.stddev for one in errors] == [0.004, 0.002, 0.002, 0.002]
    shapes = [2.5**one.power * one.lengthen(np.array([[0.6, 0.0, 0.8]])) for one in errors if one.lengthen]
    np.testing.assert_allclose(shapes, [[5.0], [3.75], [0.0], [2.8125]])
