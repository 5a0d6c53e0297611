"""Misalignment of sensors, and its growth with a displacement."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.result import BoardOutline, Calibration, Correction, EstimatedParameter
from calgraph.sensors import CameraModel
from calgraph.viewer.panel import compute_misalignments
from calgraph.viewer.view_state import ViewState

Cameras = dict[str, CameraModel]
CAMERA = "camera/front *1*"


def test_without_noise_nothing_is_misaligned(rig: Calibration, cameras: Cameras) -> None:
    found = compute_misalignments(rig, cameras, ViewState())
    assert {name: fit.unit for name, fit in found.items()} == {"lidar": "m", CAMERA: "px", "laser": "m"}
    assert max(fit.rms for fit in found.values()) < 1e-6


def test_a_displacement_towards_the_board_is_the_misalignment(rig: Calibration, cameras: Cameras) -> None:
    found = compute_misalignments(
        rig, cameras, ViewState(1.0, moved_sensor="laser", displacement=(0.05, 0, 0, 0, 0, 0))
    )
    assert found["laser"].rms == pytest.approx(0.05, abs=1e-6)
    assert found["lidar"].rms < 1e-6
    assert found["laser"].formatted == "50.0 mm"


def test_a_displacement_along_the_board_is_not_a_misalignment(rig: Calibration, cameras: Cameras) -> None:
    assert (
        compute_misalignments(rig, cameras, ViewState(moved_sensor="laser", displacement=(0, 0.05, 0, 0, 0, 0)))[
            "laser"
        ].rms
        < 1e-6
    )


def test_a_camera_moved_sideways_has_reprojection_errors(rig: Calibration, cameras: Cameras) -> None:
    """By 10 mm at 3, 3.5 and 4 m with a focal length of 400 px."""
    found = compute_misalignments(
        rig, cameras, ViewState(moved_sensor=CAMERA, displacement=(0, 0.01, 0, 0, 0, 0))
    )[CAMERA]
    expected = np.sqrt(np.mean((400 * 0.01 / np.array([3, 3.5, 4])) ** 2))
    assert found.rms == pytest.approx(expected, rel=1e-6)
    assert found.formatted == f"{expected:.2f} px"


def test_corrected_points_of_a_biased_lidar_are_on_the_board(rig: Calibration, cameras: Cameras) -> None:
    """A LiDAR that measures 40 mm short: points at the edge of the board are less off than those ahead."""
    short = EstimatedParameter("lidar", "range bias", "m", 0.0, 0.02, -0.04, 0.001)
    views = [
        replace(view, measured=view.measured * (1 - 0.04 / np.linalg.norm(view.measured, axis=1))[:, None])
        if view.sensor == "lidar"
        else view
        for view in rig.pictures.board_views
    ]
    biased = replace(
        rig,
        pictures=replace(rig.pictures, board_views=tuple(views)),
        corrections={"lidar": Correction("lidar3d", (short,), np.array([[1e-6]]), 3.5)},
    )
    before = compute_misalignments(biased, cameras, ViewState())["lidar"].rms
    after = compute_misalignments(biased.with_corrected_points(), cameras, ViewState())["lidar"].rms
    assert before == pytest.approx(0.04, rel=0.03)
    assert after < 1e-6


def test_the_misalignment_of_noise_is_its_rms(
    rig: Calibration, cameras: Cameras, rng: np.random.Generator
) -> None:
    views = [view for view in rig.pictures.board_views if view.sensor == CAMERA]
    off = [rng.normal(0, 0.3, view.measured.shape) for view in views]
    noisy = replace(
        rig,
        pictures=replace(
            rig.pictures,
            board_views=tuple(
                replace(v, measured=v.measured + o, residuals=o) for v, o in zip(views, off, strict=True)
            ),
        ),
    )
    expected = np.sqrt(np.mean(np.sum(np.concatenate(off) ** 2, axis=1)))
    assert compute_misalignments(noisy, cameras, ViewState())[CAMERA].rms == pytest.approx(expected, rel=1e-6)


def test_views_are_assigned_to_the_nearest_of_two_boards(rig: Calibration, cameras: Cameras) -> None:
    other = tuple(
        BoardOutline(o.capture, o.corners + np.array([1, 2, 0.5]), 1) for o in rig.pictures.board_outlines
    )
    found = compute_misalignments(
        replace(rig, pictures=replace(rig.pictures, board_outlines=(*other, *rig.pictures.board_outlines))),
        cameras,
        ViewState(),
    )
    assert max(fit.rms for fit in found.values()) < 1e-6


def test_views_that_were_not_used_do_not_count(rig: Calibration, cameras: Cameras) -> None:
    unused = tuple(
        replace(v, used=False, residuals=None) if v.sensor == "laser" else v for v in rig.pictures.board_views
    )
    assert "laser" not in compute_misalignments(
        replace(rig, pictures=replace(rig.pictures, board_views=unused)), cameras, ViewState()
    )
