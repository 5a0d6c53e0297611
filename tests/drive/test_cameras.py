"""Cameras in drives: images are searched for boards, and cameras alone are calibrated from those that they see."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calgraph.config import Rig
from calgraph.drive.options import DriveOptions
from calgraph.drive.pipeline import calibrate_sources
from calgraph.drive.sources.camera import CameraSource, find_boards, models_of
from calgraph.drive.start import choose_lead
from calgraph.errors import InputError
from calgraph.geometry import se3
from calgraph.parallel.engine import THIS_PROCESS
from calgraph.parallel.progress import no_progress
from calgraph.recording.input_checks import InputMonitor
from calgraph.recording.record_list import MessageRecording
from calgraph.sensors import CameraModel, Image
from calgraph.sensors.kinds.stated import Intrinsics
from calgraph.simulation import STANDARD_RIGS, DriveScenario, simulate_drive
from calgraph.simulation.camera_render import (
    build_render_context,
    build_texture_pyramid,
    draw_board,
    render_board_texture,
)
from calgraph.simulation.drive_scenario import CameraErrors
from calgraph.simulation.solids import BoxShape, Solid
from drive_board_scenes import CAMERA, MOUNTED, place_boards, see
from drive_detections import detect_views
from drive_scenes import drive


def two_cameras(boards: int) -> Rig:
    """A rig of two cameras with one lens, and boards with a tag each."""
    stated = Intrinsics.from_camera(CAMERA).model_dump(exclude_none=True)
    board = [{"size": [0.6, 0.6], "tags": [{"id": b, "size": 0.5}]} for b in range(boards)]
    return Rig.model_validate({
        "root": "front",
        "target": {"kind": "surroundings", "boards": board},
        "sensors": {
            name: {"kind": "camera", "topic": f"/{name}", "intrinsics": stated} for name in ("front", "left")
        },
    })  # fmt: skip


def test_cameras_alone_that_see_no_board_together() -> None:
    """Their clocks differ by 80 ms; nothing is known of poses."""
    rng = np.random.default_rng(3)
    times = np.arange(0, 20, 0.1)
    boards = place_boards(drive(times, 3), 14, rng)
    sources = {
        name: CameraSource(see(drive(times, 3) @ T, times + clock, boards, CAMERA, 0.1, rng))
        for name, T, clock in zip(("front", "left"), MOUNTED, (0.0, 0.08), strict=True)
    }
    calibration = calibrate_sources(two_cameras(14), sources, {}, (), DriveOptions())
    left = calibration["left"]
    error = se3.difference(left.T_root_sensor, se3.inverse(MOUNTED[0]) @ MOUNTED[1])
    # The scale of the prints, known to 0.5 % of 0.5 m, is the larger part.
    assert np.linalg.norm(error[:3]) < 0.008
    assert np.degrees(np.linalg.norm(error[3:])) < 0.2
    assert left.clock_offset == pytest.approx(0.08, abs=0.002)
    assert error @ np.linalg.solve(left.covariance, error) / 6 < 3
    fit = calibration.evidence.fit["left"]
    assert fit.unit == "px"
    assert fit.rms == pytest.approx(0.1, abs=0.03)
    print_scale = next(one for one in calibration.systematic if one.quantity == "print scale")
    assert print_scale.stddev == pytest.approx(0.005, rel=0.1)


def test_images_are_searched_for_boards_but_for_those_of_a_scene_at_rest() -> None:
    """Of 20 images of a scene at rest, one a second is searched; each board is found where it is."""
    rig = two_cameras(2)
    T_world_board = [se3.pose(np.diag([1.0, -1, -1]), np.array([x, 0.0, 2.0])) for x in (-0.5, 0.6)]
    room = [Solid(BoxShape(20.0, 20.0, 20.0), np.eye(4))]
    context = build_render_context(CAMERA, np.eye(4), room, np.random.default_rng(0))
    image = context.background.copy()
    for board, T in zip(rig.boards, T_world_board, strict=True):
        draw_board(image, context, T, build_texture_pyramid(render_board_texture(board, 600.0), board.size))
    pixels = np.clip(image, 0, 255).astype(np.uint8)
    images = [Image(0.1 * k, "front_optical", pixels) for k in range(20)]
    recording = MessageRecording({"/front": images, "/left": [Image(0.0, "", pixels)]})
    found, frames = find_boards(rig, recording, InputMonitor(rig, 0.0), THIS_PROCESS, no_progress)
    assert frames["front"] == "front_optical"
    assert [(round(view.time, 1), view.board) for view in found["front"].views] == [
        (0.0, 0), (0.0, 1), (1.0, 0), (1.0, 1),
    ]  # fmt: skip
    for view in found["front"].views:
        assert_allclose(view.T_camera_board[:3, 3], T_world_board[view.board][:3, 3], atol=0.01)


def test_cameras_need_intrinsics() -> None:
    rig = two_cameras(1)
    spec = rig.sensors["left"].model_copy(update={"intrinsics": "estimate"})
    with pytest.raises(InputError, match=r"sensors\.left\.intrinsics: a drive does not estimate them"):
        models_of(rig.model_copy(update={"sensors": {**rig.sensors, "left": spec}}))


def test_simulated_corners_are_where_boards_are() -> None:
    """Of cameras without errors, at the stated times."""
    exact = CameraErrors(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    scenario = DriveScenario(
        1, 10.0, STANDARD_RIGS["three_cameras"], "carried", "room", max_clock_offset=0.0, camera_errors=exact
    )
    found = simulate_drive(scenario)
    mounts = {mount.sensor.name: mount for mount in found.truth.mounts}
    shifts = []
    for name, views in detect_views(found).items():
        camera: CameraModel = found.truth.boards.cameras[name].true
        for view in views:
            board = found.truth.boards.boards[view.board]
            T = mounts[name].poses(found.truth.motion, np.array([view.stamp - scenario.start_time]))[0]
            tags = {tag.id: tag for tag in board.board.tags}
            middle = np.array([[*tags[int(k)].center, 0.0] for k in view.ids])
            points = se3.apply(se3.inverse(T) @ board.T_world_board, middle)
            shifts.append(np.linalg.norm(camera.project(points) - view.pixels.mean(axis=1), axis=1).max())
    assert len(shifts) > 30
    # The middle of a tag's corners is not its middle in perspective; one view in a hundred is an outlier.
    assert np.median(shifts) < 0.6
    assert np.mean(np.array(shifts) > 2.0) < 0.1


def test_a_root_that_sees_boards_for_a_shorter_time_does_not_lead() -> None:
    """The joint solution is for the other camera, and is stated for the root, with its images of boards."""
    rng = np.random.default_rng(3)
    times = np.arange(0, 26, 0.1)
    boards = place_boards(drive(times, 3), 30, rng)
    sources = {
        name: CameraSource(see((drive(times, 3) @ T)[:count], times[:count], boards, CAMERA, 0.1, rng))
        for name, T, count in zip(("front", "left"), MOUNTED, (180, 260), strict=True)
    }
    tracks = {name: source.track(rng) for name, source in sources.items()}
    assert choose_lead("front", tracks) == "left"
    calibration = calibrate_sources(two_cameras(30), sources, {}, (), DriveOptions())
    left = calibration["left"]
    error = se3.difference(left.T_root_sensor, se3.inverse(MOUNTED[0]) @ MOUNTED[1])
    assert np.linalg.norm(error[:3]) < 0.002
    assert error @ np.linalg.solve(left.covariance, error) / 6 < 3
    assert {fit.unit for fit in calibration.evidence.fit.values()} == {"px"}
    assert set(calibration.evidence.fit) == {"front", "left"}
