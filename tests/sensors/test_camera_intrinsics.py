"""How pixels depend on the intrinsics: against central differences, in all models."""

import numpy as np
import pytest

from calgraph.sensors import CameraModel

K = np.array([[400.0, 0, 320], [0, 410, 240], [0, 0, 1]])
CAMERAS = {
    "undistorted": CameraModel("pinhole", 640, 480, K, np.zeros(0)),
    "four": CameraModel("pinhole", 640, 480, K, np.array([-0.2, 0.05, 0.001, -0.002])),
    "five": CameraModel("pinhole", 640, 480, K, np.array([-0.2, 0.05, 0.001, -0.002, 0.01])),
    "rational": CameraModel("pinhole", 640, 480, K, np.array([0.1, -0.1, 0.001, 0.002, 0.05, 0.3, -0.1, 0.02])),
    "straight fisheye": CameraModel("fisheye", 640, 480, K, np.zeros(0)),
    "fisheye": CameraModel("fisheye", 640, 480, K, np.array([0.05, -0.01, 0.003, -0.001])),
}


@pytest.fixture(params=CAMERAS)
def camera(request: pytest.FixtureRequest) -> CameraModel:
    return CAMERAS[request.param]


POINTS = np.array([[0.3, -0.2, 1.0], [-0.9, 0.7, 1.1], [0.0, 0.0, 2.0], [1e-9, 0.0, 1.0], [20.0, -10.0, 30.0]])


def test_derivatives_agree_with_numerical_ones(camera: CameraModel) -> None:
    found = camera.project_by_intrinsics(POINTS)
    for i, value in enumerate(camera.intrinsics):
        step = 1e-6 * max(1.0, abs(value)) * np.eye(len(camera.intrinsics))[i]
        ahead, behind = (camera.with_intrinsics(camera.intrinsics + d).project(POINTS) for d in (step, -step))
        np.testing.assert_allclose(found[..., i], (ahead - behind) / (2 * step[i]), rtol=1e-5, atol=1e-5)


def test_a_camera_with_unchanged_intrinsics_projects_equally(camera: CameraModel) -> None:
    np.testing.assert_array_equal(
        camera.with_intrinsics(camera.intrinsics).project(POINTS), camera.project(POINTS)
    )
