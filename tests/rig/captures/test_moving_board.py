"""Detections of a moving board at the time of their capture, against a board whose motion is known."""

from collections.abc import Mapping

import numpy as np
import pytest

from calgraph.boards.detections import BoardCorners, PlanePatch, Segment
from calgraph.config.settings import MovingBoardSettings
from calgraph.geometry import Array, plane, se3
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.captures.holds import Hold
from calgraph.rig.captures.moving_board import compensate_motion
from calgraph.sensors import CameraModel

CAMERA = CameraModel("pinhole", 640, 480, np.array([[400, 0, 320], [0, 400, 240], [0, 0, 1.0]]), np.zeros(0))
CORNERS = np.array([[x, y, 0.0] for x in (-0.3, 0.0, 0.3) for y in (-0.2, 0.2)])
T_START = se3.pose(np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]), np.array([0.1, 0.0, 2.0]))
VELOCITY = np.array([0.4, -0.2, 0.3, 0.3, -0.4, 0.2])
ACCELERATION = np.array([1.0, 0.5, -1.0, 0.0, 0.0, 0.0])
SETTINGS = MovingBoardSettings()


def board_at(time: float | Array) -> Array:
    t = np.asarray(time)[..., None]
    return se3.retract(T_START, VELOCITY * t + 0.5 * ACCELERATION * t**2)


def corners_at(time: float) -> BoardCorners:
    T = board_at(time)
    pixels = CAMERA.project(se3.apply(T, CORNERS))
    return BoardCorners(CORNERS, pixels, T, np.eye(6), plane.from_pose(T), np.eye(3), 0.1)


def directions_to(points: Array) -> Array:
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))


def ranges_to(T: Array, directions: Array) -> Array:
    """Along directions (N, 3) to boards (4, 4) or (N, 4, 4)."""
    n, t = T[..., :3, 2], T[..., :3, 3]
    return np.asarray(np.sum(n * t, axis=-1) / np.sum(n * directions, axis=-1))


def patch_at(time: float, times: Array | None = None) -> PlanePatch:
    """Of a sweep whose beams are measured at ``times`` after the stamp; their mean is zero."""
    T = board_at(time)
    u = directions_to(se3.apply(T, CORNERS))
    measured = ranges_to(T if times is None else board_at(time + times), u)
    no_times = np.zeros(0) if times is None else times
    return PlanePatch(plane.from_pose(T), np.eye(3), measured, u, T[:3, 3], times=no_times)


def captures_of(detections: Mapping[str, Mapping[float, object]], **offsets: float) -> CaptureSet:
    """Frames every 50 ms; only the middle one is a capture. Offsets of the sensors' stamps from the frame."""
    holds = [
        Hold(
            k,
            0.0,
            0.0,
            {name: np.array([time + offsets.get(name, 0.0)]) for name in detections},
            auxiliary=time != 0.0,
        )
        for k, time in enumerate((0.0, -0.05, 0.05))
    ]
    found = {
        name: {k: (of[t],) for k, t in enumerate((0.0, -0.05, 0.05)) if t in of} for name, of in detections.items()
    }
    return CaptureSet(0.0, {}, tuple(holds), found, {}, {"camera": CAMERA})  # type: ignore[arg-type]


FRAMES = (0.0, -0.05, 0.05)


def test_corners_are_moved_to_the_mean_of_the_stamps() -> None:
    """The LiDAR is 20 ms late: the capture's time is 10 ms after the camera's."""
    camera = {t: corners_at(t) for t in FRAMES}
    lidar = {t: patch_at(t + 0.02) for t in FRAMES}
    moved = compensate_motion(captures_of({"camera": camera, "lidar": lidar}, lidar=0.02), SETTINGS)
    assert [hold.index for hold in moved.holds] == [0]
    (corners,), (patch,) = moved.detections["camera"][0], moved.detections["lidar"][0]
    assert isinstance(corners, BoardCorners)
    assert isinstance(patch, PlanePatch)
    assert np.abs(corners_at(0.0).pixels - corners_at(0.01).pixels).max() > 0.5
    np.testing.assert_allclose(corners.pixels, corners_at(0.01).pixels, atol=1e-3)
    np.testing.assert_allclose(corners.T_camera_board, board_at(0.01), atol=1e-5)
    np.testing.assert_allclose(patch.ranges, ranges_to(board_at(0.01), patch.directions), atol=1e-4)
    np.testing.assert_allclose(patch.plane, plane.from_pose(board_at(0.01)), atol=1e-4)


def test_the_velocity_of_the_board_is_known_in_every_point() -> None:
    moved = compensate_motion(captures_of({"camera": {t: corners_at(t) for t in FRAMES}}), SETTINGS)
    twist = moved.detections["camera"][0][0].twist
    points = se3.apply(board_at(0.0), CORNERS)
    step = 1e-5
    velocities = (se3.apply(board_at(step), CORNERS) - se3.apply(board_at(-step), CORNERS)) / (2 * step)
    np.testing.assert_allclose(twist[:3] + np.cross(twist[3:], points), velocities, atol=2e-3)


def test_beams_of_a_sweep_are_moved_from_their_own_times() -> None:
    times = np.linspace(-0.02, 0.02, len(CORNERS))
    lidar = {t: patch_at(t, times) for t in FRAMES}
    (patch,) = compensate_motion(captures_of({"lidar": lidar}), SETTINGS).detections["lidar"][0]
    assert isinstance(patch, PlanePatch)
    exact = ranges_to(board_at(0.0), patch.directions)
    assert np.abs(lidar[0.0].ranges - exact).max() > 0.005
    np.testing.assert_allclose(patch.ranges, exact, atol=3e-4)


def test_a_section_of_the_board_is_moved() -> None:
    """A 2-D scanner before a wall that comes nearer at 0.5 m/s."""

    def section(time: float) -> Segment:
        ends = np.array([[2 - 0.5 * time, -0.4, 0.0], [2 - 0.5 * time, 0.4, 0.0]])
        u = directions_to(np.array([[2, y, 0.0] for y in (-0.3, 0.0, 0.3)]))
        return Segment(ends, np.eye(6), ends[0, 0] / u[:, 0], u)

    scans = {t: section(t + 0.02) for t in FRAMES}
    images = {t: corners_at(t) for t in FRAMES}
    moved = compensate_motion(captures_of({"camera": images, "laser": scans}, laser=0.02), SETTINGS)
    (segment,) = moved.detections["laser"][0]
    assert isinstance(segment, Segment)
    np.testing.assert_allclose(segment.ranges, section(0.01).ranges, atol=1e-6)
    np.testing.assert_allclose(segment.endpoints, section(0.01).endpoints, atol=1e-6)
    np.testing.assert_allclose(segment.twist, [-0.5, 0, 0, 0, 0, 0], atol=1e-4)


def torn_patch_at(time: float) -> PlanePatch:
    """A sweep that begins and ends in the middle of the board: its left half is measured 80 ms after the other."""
    on_board = np.array([[x, y, 0.0] for x in np.linspace(-0.4, 0.4, 21) for y in np.linspace(-0.3, 0.3, 7)])
    u = directions_to(se3.apply(board_at(time), on_board))
    times = np.where(on_board[:, 0] < 0, 0.04, -0.04)
    times -= times.mean()
    measured = ranges_to(board_at(time + times), u)
    points = measured[:, None] * u
    return PlanePatch(plane.fit(points), np.eye(3), measured, u, points.mean(axis=0), times=times)


def test_the_plane_of_a_sweep_that_begins_on_the_board_is_freed_from_skew(monkeypatch: pytest.MonkeyPatch) -> None:
    found = captures_of({"lidar": {t: torn_patch_at(t) for t in FRAMES}})
    angles = []
    for rounds in (0, 2):
        monkeypatch.setattr("calgraph.rig.captures.moving_board._SKEW_ROUNDS", rounds)
        (patch,) = compensate_motion(found, SETTINGS).detections["lidar"][0]
        assert isinstance(patch, PlanePatch)
        cosine = patch.plane[:3] @ plane.from_pose(board_at(0.0))[:3]
        angles.append(float(np.arccos(np.clip(cosine, -1, 1))))
    assert angles[0] > 0.01
    assert angles[1] < 0.003


def test_without_detections_in_neighbouring_frames_the_velocity_is_noise() -> None:
    """The LiDAR is 40 ms late, and so 20 ms from the capture's time; 5 ms are the usual error of stamps."""
    found = compensate_motion(
        captures_of({"camera": {t: corners_at(t) for t in FRAMES}, "lidar": {0.0: patch_at(0.0)}}, lidar=0.04),
        SETTINGS,
    )
    assert not found.rejections
    (patch,), (corners,) = found.detections["lidar"][0], found.detections["camera"][0]
    assert isinstance(patch, PlanePatch)
    np.testing.assert_array_equal(patch.twist, np.zeros(6))
    np.testing.assert_allclose(patch.plane, plane.from_pose(board_at(0.0)))
    stddev = np.sqrt(patch.motion_variance / (0.02**2 + 0.005**2))
    # Two steps of the camera with the board's velocity, and the limits of speed once.
    usual = [np.sqrt((2 * np.mean(VELOCITY[axes] ** 2) + (limit / 4) ** 2) / 3)
             for axes, limit in ((slice(3), 3.0), (slice(3, 6), 6.0))]  # fmt: skip
    np.testing.assert_allclose(stddev, np.repeat(usual, 3), rtol=0.05)
    assert (corners.motion_variance < 1e-3 * patch.motion_variance).all()


@pytest.mark.parametrize("interval", [0.05, 0.17, 0.34, 0.7])
def test_variances_of_unknown_motion_hold_at_all_distances_of_frames(interval: float) -> None:
    """A hand at 0.3 to 1 Hz, 60 ms from the capture: squared errors are about their variances."""
    rng, off, late = np.random.default_rng(0), 0.12, 0.5 * 0.12
    squared = []
    for _ in range(30):
        frequency, phase = rng.uniform(2, 6, 6), rng.uniform(0, 2 * np.pi, 6)
        speed = np.array([0.3, 0.3, 0.3, 0.5, 0.5, 0.5]) * np.sqrt(2)

        def pose(t: float, f: Array = frequency, p: Array = phase, s: Array = speed) -> Array:
            return np.asarray(se3.retract(T_START, s / f * (np.sin(f * t + p) - np.sin(p))))

        def corners(T: Array) -> BoardCorners:
            pixels = CAMERA.project(se3.apply(T, CORNERS))
            return BoardCorners(CORNERS, pixels, T, np.eye(6), plane.from_pose(T), np.eye(3), 0.1)

        times = interval * np.arange(-4, 5)
        holds = tuple(Hold(k, 0.0, 0.0, {"camera": np.array([t]), "other": np.array([t + off])})
                      for k, t in enumerate(times))  # fmt: skip
        found = {"camera": {k: (corners(pose(t)),) for k, t in enumerate(times)},
                 "other": {k: (corners(pose(t + off)),) for k, t in enumerate(times)}}  # fmt: skip
        cameras = {"camera": CAMERA, "other": CAMERA}
        moved = compensate_motion(CaptureSet(0.0, {}, holds, found, {}, cameras), SETTINGS)
        one = moved.detections["camera"][4][0]
        assert isinstance(one, BoardCorners)
        # Without the part for unknown errors of the stamps.
        variance = one.motion_variance * late**2 / (late**2 + 0.005**2)
        squared.append(se3.difference(one.T_camera_board, pose(late)) ** 2 / np.maximum(variance, 1e-4**2))
    assert 0.05 < np.mean(squared) < 1.8
    if interval > 0.1:
        assert np.mean(squared) > 0.3


def test_one_neighbouring_frame_suffices() -> None:
    camera = {0.0: corners_at(0.0), 0.05: corners_at(0.05)}
    moved = compensate_motion(captures_of({"camera": camera}), SETTINGS).detections["camera"][0][0]
    error = 4.0 * 0.05 / 2
    mean = se3.difference(board_at(0.05), board_at(0.0)) / 0.05 / (1 + error**2)
    t = board_at(0.0)[:3, 3]
    np.testing.assert_allclose(moved.twist, [*(mean[:3] - np.cross(mean[3:], t)), *mean[3:]], atol=1e-9)


@pytest.mark.parametrize(("settings", "known"), [(SETTINGS, True), (MovingBoardSettings(max_speed=0.3), False)])
def test_impossible_motions_are_no_velocities(settings: MovingBoardSettings, known: bool) -> None:
    moved = compensate_motion(captures_of({"camera": {t: corners_at(t) for t in FRAMES}}), settings)
    assert bool(np.any(moved.detections["camera"][0][0].twist)) == known
