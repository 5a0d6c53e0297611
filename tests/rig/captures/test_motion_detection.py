from copy import copy
from functools import partial
from itertools import islice

import numpy as np
import pytest

from calgraph.config import Board, Lidar2dSpec, Rig, SensorSpec, Tag
from calgraph.geometry import Array
from calgraph.parallel.engine import Processes
from calgraph.recording import MessageRecording
from calgraph.recording.cache import NO_CACHE
from calgraph.rig.captures.motion_detection import BASELINE, ActivityMeter, measure_block
from calgraph.rig.captures.timeline import RecordingTimeline, SensorTimes
from calgraph.rig.captures.timeline_reading import measure_activity
from calgraph.sensors import DetectedCorners, Image, LaserScan, PointCloud


def image(pixels: Array) -> Image:
    return Image(0.0, "", pixels.astype(np.uint8))


def test_a_moved_board_changes_an_image_and_noise_does_not(rng: np.random.Generator) -> None:
    wall = np.full((240, 320), 120.0)
    board = wall.copy()
    board[60:180, 100:200] = 240
    meter = ActivityMeter(BASELINE)
    meter.measure_change(image(wall + rng.normal(0, 3, wall.shape)))
    assert meter.measure_change(image(wall + rng.normal(0, 3, wall.shape))) == 0
    assert meter.measure_change(image(board + rng.normal(0, 3, wall.shape))) > 0.1


def test_a_board_in_front_of_the_wall_changes_a_scan_and_noise_does_not(rng: np.random.Generator) -> None:
    angles = np.linspace(-2, 2, 800)
    wall = 4 + rng.normal(0, 0.015, 800)
    board = np.where(np.abs(angles) < 0.2, 2.0, wall)
    meter = ActivityMeter(BASELINE)
    meter.measure_change(LaserScan(0.0, "", angles, wall))
    assert meter.measure_change(LaserScan(0.0, "", angles, wall + rng.normal(0, 0.015, 800))) < 0.02
    assert meter.measure_change(LaserScan(0.0, "", angles, board)) > 0.08


def test_beams_that_lose_their_return_count_as_change() -> None:
    angles = np.linspace(-2, 2, 100)
    meter = ActivityMeter(BASELINE)
    meter.measure_change(LaserScan(0.0, "", angles, np.full(100, 3.0)))
    assert meter.measure_change(LaserScan(0.0, "", angles, np.where(angles < 0, np.nan, 3.0))) > 0.4


def test_a_moved_board_changes_a_cloud(rng: np.random.Generator) -> None:
    wall = np.column_stack([np.full(2000, 5.03), rng.uniform(-3, 3, 2000), rng.uniform(-1, 1, 2000)])
    board = np.column_stack([np.full(500, 2.03), rng.uniform(-0.5, 0.5, 500), rng.uniform(-0.5, 0.5, 500)])
    meter = ActivityMeter(BASELINE)
    meter.measure_change(PointCloud(0.0, "", np.vstack([wall, board])))
    same = meter.measure_change(PointCloud(0.0, "", np.vstack([wall, board + rng.normal(0, 0.02, board.shape)])))
    moved = meter.measure_change(PointCloud(0.0, "", np.vstack([wall, board + np.array([0.5, 0, 0])])))
    assert same == 0
    assert moved > 0.03


def test_a_message_without_returns_shows_neither_motion_nor_rest(rng: np.random.Generator) -> None:
    points = rng.uniform(-5, 5, (500, 3))
    angles, ranges = np.linspace(-1, 1, 50), np.full(50, 3.0)
    nearer = np.where(angles > 0, 1.0, 3.0)
    meter = ActivityMeter(BASELINE)
    clouds = [points, np.zeros((0, 3)), points, points + np.array([1.0, 0.0, 0.0])]
    changes = [meter.measure_change(PointCloud(float(k), "", p)) for k, p in enumerate(clouds)]
    np.testing.assert_array_equal(changes[:3], [0.0, np.nan, 0.0])
    assert changes[3] > 0.3
    meter = ActivityMeter(BASELINE)
    scans = [ranges, np.full(50, np.nan), ranges, nearer]
    found = [meter.measure_change(LaserScan(float(k), "", angles, r)) for k, r in enumerate(scans)]
    np.testing.assert_array_equal(found, [0, np.nan, 0, 0.5])


def test_detected_corners_that_move_or_vanish_are_change_and_noise_is_not(rng: np.random.Generator) -> None:
    points = np.column_stack([rng.permutation(20) * 0.01, np.zeros((20, 2))])
    pixels = rng.uniform(0, 500, (20, 2))
    meter = ActivityMeter(BASELINE)
    meter.measure_change(DetectedCorners(0.0, "", points, pixels))
    assert meter.measure_change(DetectedCorners(1.0, "", points[::-1], pixels[::-1] + 0.2)) == 0
    assert meter.measure_change(DetectedCorners(2.0, "", points, pixels + 5.0)) == 1
    assert np.isnan(meter.measure_change(DetectedCorners(3.0, "", points[:0], pixels[:0])))
    assert meter.measure_change(DetectedCorners(4.0, "", points[:15], pixels[:15] + 5.0)) == 0.25


@pytest.mark.parametrize("sizes", [[7], [1, 6], [2, 2, 3], [3, 1, 1, 2]])
def test_blocks_that_are_measured_apart_have_the_changes_of_the_whole(
    sizes: list[int], rng: np.random.Generator
) -> None:
    """Messages without returns are left out, also at the end and at the start of a block."""
    points = rng.uniform(-5, 5, (500, 3))
    shifts: list[float | None] = [None, 0.0, 0.5, None, None, 0.5, 2.0]
    clouds = [
        PointCloud(float(k), "", np.zeros((0, 3)) if shift is None else points + shift)
        for k, shift in enumerate(shifts)
    ]
    whole, parts = ActivityMeter(BASELINE), ActivityMeter(BASELINE)
    decoders = iter([partial(copy, cloud) for cloud in clouds])
    blocks = [measure_block(list(islice(decoders, size))) for size in sizes]
    changes = [change for block in blocks for change in parts.join(block)]
    np.testing.assert_array_equal(changes, [whole.measure_change(cloud) for cloud in clouds])
    assert changes[2] > 0.3


@pytest.mark.parametrize("jobs", [1, 3])
def test_the_activity_of_a_recording_is_that_of_its_messages_in_turn(jobs: int, rng: np.random.Generator) -> None:
    angles = np.linspace(-1, 1, 50)
    scans = {name: [LaserScan(0.1 * k, name, angles, rng.uniform(1, 5, 50)) for k in range(70)] for name in "ab"}
    specs: dict[str, SensorSpec] = {name: Lidar2dSpec(kind="lidar2d", topic=f"/{name}") for name in scans}
    rig = Rig(root="a", target=Board(size=(1, 1), tags=(Tag(id=0, size=0.5),)), sensors=specs)
    recording = MessageRecording({f"/{name}": messages for name, messages in scans.items()})
    times = SensorTimes(np.linspace(0.0, 6.9, 70), 0.0, np.zeros(70))
    timeline = RecordingTimeline(0.0, dict.fromkeys(scans, times), np.zeros(0))
    found = measure_activity(timeline, rig, recording, NO_CACHE, lambda _arrival: None, Processes(jobs))
    for name, messages in scans.items():
        meter = ActivityMeter(BASELINE)
        assert found.sensors[name].activity.tolist() == [meter.measure_change(scan) for scan in messages]
