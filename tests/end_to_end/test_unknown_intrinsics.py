"""Rigs whose cameras have no intrinsics: estimated from the same recording, judged by the truth."""

import numpy as np
import pytest

from calgraph.config import CameraSpec, Rig
from calgraph.result import Calibration, state_calibrated_intrinsics
from calgraph.rig.bundle.problem import Problem
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem, solve_problem
from calgraph.sensors import CameraModel
from calgraph.simulation import (
    CameraOptions,
    GroundTruth,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    build_world,
)
from calgraph.simulation.robot import MountedCamera
from simulated_rigs import (
    SimulatedRecording,
    build_recording,
    calibrate,
    keep_decoded,
    pose_errors,
    simulate_scenario,
)

pytestmark = pytest.mark.slow

LENSES = {
    "pinhole": CameraOptions(
        width=640, height=480, field_of_view=80, distortion=(-0.2, 0.06, 1e-3, -5e-4, 0.0), texels_per_mm=1.0
    ),
    "fisheye": CameraOptions(
        width=640, height=480, field_of_view=160, model="fisheye", distortion=(0.03, -0.01, 0.003, -0.001),
        texels_per_mm=1.0,
    ),
}  # fmt: skip
REACH = {"pinhole": (34.0, 1.3), "fisheye": (70.0, 0.8)}
"""Largest bearing of the board, degrees, and its distance, m."""
Recorded = tuple[Rig, SimulatedRecording, GroundTruth, CameraModel]
OPTIONS = RigOptions(folds=0)


def record(lens: str, **knobs: object) -> Recorded:
    """A recording without CameraInfo, its rig without intrinsics, and the true camera."""
    bearing, radius = REACH[lens]
    scenario = RigScenario(
        camera=LENSES[lens],
        laser=LaserOptions(count=0),
        spinning=SpinningOptions(count=0),
        multibeam=MultibeamOptions(count=1, rate=4.0, rings=32, resolution=0.4),
        bearings=tuple(np.linspace(-bearing, bearing, 10)),
        radii=(radius, 1.5 * radius),
        samples=1,
        max_rotation=40.0,
        heights=(0.5, 1.5),
        clutter=4,
        move_time=0.4,
    ).model_copy(update=knobs)
    rig, recording, truth = simulate_scenario(scenario, 3)
    robot = build_world(scenario, 3, images=False).robot
    cameras = [one.camera for one in robot if isinstance(one, MountedCamera)]
    bare = build_recording(r for r in recording.messages if not r.topic.endswith("camera_info"))
    return change_camera(rig, camera_info=None), keep_decoded(bare), truth, cameras[0]


def change_camera(rig: Rig, **keys: object) -> Rig:
    spec = CameraSpec.model_validate({**rig.sensors["camera"].model_dump(exclude_none=True), **keys})
    return rig.model_copy(update={"sensors": {**rig.sensors, "camera": spec}})


def state(rig: Rig, camera: CameraModel) -> Rig:
    """The rig with the true intrinsics."""
    K = [*camera.focal.tolist(), *camera.principal_point.tolist()]
    return change_camera(
        rig,
        intrinsics={
            "model": camera.model, "width": camera.width, "height": camera.height, "K": K,
            "distortion": camera.distortion.tolist(),
        },
    )  # fmt: skip


@pytest.fixture(scope="module", params=["pinhole", "fisheye"])
def recorded(request: pytest.FixtureRequest) -> Recorded:
    return record(request.param)


@pytest.fixture(scope="module")
def built(recorded: Recorded) -> Problem:
    return build_problem(recorded[0], recorded[1], OPTIONS)


@pytest.fixture(scope="module")
def calibrated(built: Problem) -> Calibration:
    """What ``calibrate_rig`` returns, in its two steps."""
    return solve_problem(built)


def estimated_camera(calibration: Calibration) -> CameraModel:
    intrinsics = calibration["camera"].intrinsics
    assert intrinsics is not None
    return intrinsics.to_camera()


def test_poses_are_as_good_as_with_the_true_intrinsics(recorded: Recorded, calibrated: Calibration) -> None:
    rig, recording, truth, camera = recorded
    with_truth = calibrate(state(rig, camera), recording, OPTIONS)
    error, reference = pose_errors(calibrated, truth)["camera"], pose_errors(with_truth, truth)["camera"]
    stddev = np.sqrt(np.diag(calibrated["camera"].covariance))
    assert calibrated["camera"].verdict.grade == "good"
    assert np.all(np.abs(error) < 3.5 * stddev)
    # Single errors are random: the difference is small beside them.
    assert np.all(np.abs(error - reference) < 1.5 * stddev)
    np.testing.assert_array_less(stddev, 1.5 * np.sqrt(np.diag(with_truth["camera"].covariance)))


def test_intrinsics_are_those_of_the_lens(recorded: Recorded, calibrated: Calibration) -> None:
    truth, found = recorded[3], estimated_camera(calibrated)
    assert found.model == truth.model
    np.testing.assert_allclose(found.focal, truth.focal, rtol=0.003)
    np.testing.assert_allclose(found.principal_point, truth.principal_point, atol=1.5)
    assert any(
        text.startswith(f"the intrinsics of camera were estimated from this recording: {truth.model}, ")
        for text in calibrated.evidence.remarks
    )


def test_the_resolved_rig_gives_the_same_result(recorded: Recorded, calibrated: Calibration) -> None:
    rig, recording, *_ = recorded
    again = calibrate(state_calibrated_intrinsics(rig, calibrated), recording, OPTIONS)
    stddev = np.sqrt(np.diag(calibrated["camera"].covariance))
    difference = pose_errors(again, recorded[2])["camera"] - pose_errors(calibrated, recorded[2])["camera"]
    # Tags are detected again, in views that are rectified with slightly different intrinsics.
    assert np.all(np.abs(difference) < 2 * stddev)
    assert again["camera"].intrinsics is not None


def test_views_that_do_not_suffice_leave_the_camera_out_with_the_reason() -> None:
    rig, recording, *_ = record("pinhole", bearings=(-10.0, 0.0, 10.0), radii=(2.0,))
    calibration = calibrate(rig, recording, OPTIONS)
    assert [sensor.name for sensor in calibration.sensors] == ["lidar"]
    reason = calibration.evidence.unconnected["camera"]
    assert "3 images with at least 8 corners of the board do not determine its intrinsics, which need 5" in reason


def test_the_covariance_of_the_estimate_is_no_prior(built: Problem) -> None:
    prior = built.rig.cameras()["camera"].uncertainty
    assert prior.focal_length == 0.5
    assert prior.principal_point == pytest.approx(200)


@pytest.mark.parametrize("recorded", ["pinhole"], indirect=True)
def test_a_stated_model_is_used_even_if_intrinsics_are_recorded(recorded: Recorded) -> None:
    rig, recording, *_ = recorded
    problem = build_problem(change_camera(rig, intrinsics="estimate fisheye"), recording, OPTIONS)
    assert problem.captures.cameras["camera"].model == "fisheye"
