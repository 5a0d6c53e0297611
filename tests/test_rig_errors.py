"""Measurements of a world that differs from rig.yaml: each error changes them as physics has it."""

from collections.abc import Callable

import numpy as np
import pytest

from calgraph.boards.detections import BoardCorners, PlanePatch, Segment
from calgraph.config import Board
from calgraph.errors import InputError
from calgraph.geometry import Array, Index, se3, so3
from calgraph.rig.captures.detect import CaptureSet
from calgraph.sensors import CameraModel
from calgraph.simulation import (
    CameraOptions,
    GroundTruth,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    World,
    build_world,
)
from ideal_detections import IdealDetectorOptions, simulate_detections
from rig_errors import BoardErrors, Bump, CameraErrors, ModelErrors, ScannerErrors

RINGS = 8
SCENARIO = RigScenario(
    camera=CameraOptions(width=640, height=480),
    laser=LaserOptions(count=1, range_noise=0.0),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=1, rings=RINGS, lowest=-12.0, highest=8.0, range_noise=0.0),
    bearings=(-20, -10, 0, 10, 20),
    radii=(1.7,),
    background=1.0,
)
BOARD = SCENARIO.board
HALF = 0.5 * np.array(BOARD.size)
# Hardly any noise, and so much stated that no corner is an outlier.
EXACT = IdealDetectorOptions(pixel=1e-4, stated_noise_factor=1e4)


@pytest.fixture(scope="module")
def world() -> World:
    return build_world(SCENARIO, 0, images=False)


def poses(truth: GroundTruth, name: str) -> Array:
    """``T_sensor_board`` (C, 4, 4)."""
    T_root_board = np.array([board.T_root_board for board in truth.boards])
    return np.asarray(se3.inverse(truth.T_root_sensor[name]) @ T_root_board)


def simulate(world: World, errors: ModelErrors) -> tuple[CaptureSet, GroundTruth]:
    _, captured, truth = simulate_detections(world, 0, EXACT, errors)
    return captured, truth


def pixel_errors(world: World, errors: ModelErrors, move: Callable[[Array], Array], camera: CameraModel) -> Array:
    """(N, 2) measured pixels minus those of corners that ``move`` displaces, before this camera."""
    captured, truth = simulate(world, errors)
    found = []
    for capture, (detection,) in captured.detections["camera"].items():
        assert isinstance(detection, BoardCorners)
        moved = move(detection.corners_board.copy())
        found.append(detection.pixels - camera.project(se3.apply(poses(truth, "camera")[capture], moved)))
    assert len(found) >= 4
    return np.concatenate(found)


def board_errors(world: World, board: BoardErrors, move: Callable[[Array], Array]) -> Array:
    stated = simulate(world, ModelErrors())[0].cameras["camera"]
    return pixel_errors(world, ModelErrors(board), move, stated)


def beams(world: World, errors: ModelErrors, name: str) -> list[tuple[int, PlanePatch | Segment, Array]]:
    """Capture, detection and true ``T_sensor_board``."""
    captured, truth = simulate(world, errors)
    found = []
    for capture, (detection,) in captured.detections[name].items():
        assert isinstance(detection, PlanePatch | Segment)
        found.append((capture, detection, poses(truth, name)[capture]))
    assert len(found) >= 4
    return found


def range_errors(detection: PlanePatch | Segment, T_sensor_board: Array) -> tuple[Array, Array]:
    """Measured minus true ranges (N,) to the plane of the board, and the true ones."""
    n, t = T_sensor_board[:3, 2], T_sensor_board[:3, 3]
    true = n @ t / (detection.directions @ n)
    return detection.ranges - true, true


def on_face(points: Array, T_sensor_board: Array) -> Array:
    """Points (N, 3) in the frame of the board."""
    return se3.apply(se3.inverse(T_sensor_board), points)


def test_without_errors_the_world_is_as_stated(world: World) -> None:
    assert np.abs(board_errors(world, BoardErrors(), lambda corners: corners)).max() < 0.001
    for _, detection, T in beams(world, ModelErrors(), "lidar"):
        assert np.abs(range_errors(detection, T)[0]).max() < 1e-9


def test_a_larger_print_looks_larger(world: World) -> None:
    errors = board_errors(world, BoardErrors(print_scale=0.02), lambda corners: 1.02 * corners)
    assert np.abs(errors).max() < 0.001


def test_a_print_with_a_wrong_aspect_is_wider_and_less_high(world: World) -> None:
    errors = board_errors(world, BoardErrors(print_aspect=0.01), lambda corners: corners * [1.005, 0.995, 1.0])
    assert np.abs(errors).max() < 0.001


def test_a_displaced_print_and_a_displaced_tag(world: World) -> None:
    def move(corners: Array) -> Array:
        of_tag_2 = corners[:, 1] < 0
        return corners + np.where(of_tag_2[:, None], [0.003, -0.008, 0.0], [0.003, 0.002, 0.0])

    board = BoardErrors(print_position=(0.003, 0.002), tag_position={2: (0.0, -0.01)})
    assert np.abs(board_errors(world, board, move)).max() < 0.001


def test_a_turned_print_and_a_turned_tag(world: World) -> None:
    def move(corners: Array) -> Array:
        of_tag_2 = corners[:, 1] < 0
        center = np.array([*BOARD.tags[2].center, 0.0])
        turned = center + (corners - center) @ so3.exp(np.array([0.0, 0.0, 0.02])).T
        corners = np.where(of_tag_2[:, None], turned, corners)
        return np.asarray(corners @ so3.exp(np.array([0.0, 0.0, -0.01])).T)

    board = BoardErrors(print_rotation=-0.01, tag_rotation={2: 0.02})
    assert np.abs(board_errors(world, board, move)).max() < 0.001


def test_larger_tags_keep_their_centres(world: World) -> None:
    def move(corners: Array) -> Array:
        centers = np.array([tag.center for tag in BOARD.tags])
        nearest = np.linalg.norm(corners[:, None, :2] - centers, axis=-1).argmin(axis=1)
        middle = np.column_stack([centers[nearest], np.zeros(len(corners))])
        return np.asarray(middle + 1.05 * (corners - middle))

    assert np.abs(board_errors(world, BoardErrors(tag_size=0.05), move)).max() < 0.001


@pytest.mark.parametrize("bow", [(0.005, 0.0, 0.0), (0.005, -0.005, 0.002)])
def test_a_bent_board_has_corners_and_points_off_its_plane(world: World, bow: tuple[float, float, float]) -> None:
    def height(points: Array) -> Array:
        x, y = (points[:, :2] / HALF).T
        return np.asarray(bow[0] * x**2 + bow[1] * y**2 + bow[2] * x * y)

    def move(corners: Array) -> Array:
        return np.column_stack([corners[:, :2], height(corners)])

    assert np.abs(board_errors(world, BoardErrors(bow=bow), move)).max() < 0.001
    highest = 0.0
    for name in ("lidar", "laser_front"):
        for _, detection, T in beams(world, ModelErrors(BoardErrors(bow=bow)), name):
            points = on_face(detection.points, T)
            assert np.abs(points[:, 2] - height(points)).max() < 1e-6
            highest = max(highest, float(points[:, 2].max()))
    assert highest > 0.003


def outline_excess(world: World, errors: ModelErrors) -> tuple[Array, Array]:
    """How far the edges of the laser lie outside the stated outline in x (N,), and their ranges (N,)."""
    excess, ranges = [], []
    for _, detection, T in beams(world, errors, "laser_front"):
        middle = detection.edges.mean(axis=1)
        n, t = T[:3, 2], T[:3, 3]
        points = (n @ t / (middle @ n))[:, None] * middle
        excess.append(np.abs(on_face(points, T)[:, 0]) - HALF[0])
        ranges.append(np.linalg.norm(points, axis=1))
    return np.concatenate(excess), np.concatenate(ranges)


def test_a_wider_board_has_its_outline_farther_out(world: World) -> None:
    stated, wide = (outline_excess(world, ModelErrors(BoardErrors(size=size)))[0] for size in ((0, 0), (0.03, 0)))
    assert np.median(wide) - np.median(stated) == pytest.approx(0.015, abs=0.004)


def test_a_divergent_beam_widens_the_board_by_half_its_footprint(world: World) -> None:
    stated, _ = outline_excess(world, ModelErrors())
    wide, ranges = outline_excess(world, ModelErrors(scanners={"laser_front": ScannerErrors(divergence=0.006)}))
    footprint = 0.006 * ranges
    # On an inclined board the footprint is longer than across the beam; the scan crosses a rolled one obliquely.
    assert ((wide - stated) / footprint > 0.43).all()
    assert ((wide - stated) / footprint < 0.9).all()
    assert np.median((wide - stated) / footprint) == pytest.approx(0.5, abs=0.05)


def test_errors_of_a_lens_displace_pixels(world: World) -> None:
    stated = simulate(world, ModelErrors())[0].cameras["camera"]
    wrong = CameraErrors(focal_length=(0.03, 0.01), principal_point=(10.0, -4.0))
    K = stated.K * [[1.03, 1, 1], [1, 1.01, 1], [1, 1, 1]] + [[0, 0, 10], [0, 0, -4], [0, 0, 0]]
    true = CameraModel("pinhole", 640, 480, K, stated.distortion)
    errors = pixel_errors(world, ModelErrors(cameras={"camera": wrong}), lambda corners: corners, true)
    assert np.abs(errors).max() < 0.001


def test_a_distortion_that_is_not_stated_bends_the_image(world: World) -> None:
    stated = simulate(world, ModelErrors())[0].cameras["camera"]
    true = CameraModel("pinhole", 640, 480, stated.K, np.array([-0.1, 0.01, 0, 0, 0]))
    lens = CameraErrors(lens=true)
    errors = pixel_errors(world, ModelErrors(cameras={"camera": lens}), lambda corners: corners, true)
    assert np.abs(errors).max() < 0.001


def test_changes_of_stated_coefficients_bend_the_image() -> None:
    lens = CameraModel("pinhole", 640, 480, np.eye(3), np.array([-0.1, 0.0, 0.0, 0.0]))
    assert CameraErrors(distortion=(0.02, 0.01)).true_camera(lens).distortion == pytest.approx([-0.08, 0.01, 0, 0])


def test_an_image_is_shifted_from_the_middle_of_the_recording(world: World) -> None:
    shifted = CameraErrors(image_shift=(15.0, 0.0), image_shift_after=0.5)
    captured, truth = simulate(world, ModelErrors(cameras={"camera": shifted}))
    count, camera = len(truth.boards), captured.cameras["camera"]
    halves: dict[bool, list[float]] = {False: [], True: []}
    for capture, (detection,) in captured.detections["camera"].items():
        assert isinstance(detection, BoardCorners)
        expected = camera.project(se3.apply(poses(truth, "camera")[capture], detection.corners_board))
        halves[capture >= count / 2].append(float((detection.pixels - expected).mean(axis=0)[0]))
    assert halves[False] == pytest.approx([0.0] * len(halves[False]), abs=0.001)
    assert halves[True] == pytest.approx([15.0] * len(halves[True]), abs=0.001)


def test_range_bias_and_scale_add_to_ranges(world: World) -> None:
    wrong = ScannerErrors(range_bias=-0.03, range_scale=0.01)
    for name in ("lidar", "laser_front"):
        for _, detection, T in beams(world, ModelErrors(scanners={name: wrong}), name):
            error, true = range_errors(detection, T)
            assert error == pytest.approx(0.01 * true - 0.03, abs=1e-9)


def test_with_a_wrong_increment_beams_end_at_larger_angles(world: World) -> None:
    wrong = ModelErrors(scanners={"laser_front": ScannerErrors(angle_scale=0.01)})
    for _, detection, T in beams(world, wrong, "laser_front"):
        angles = np.arctan2(detection.directions[:, 1], detection.directions[:, 0])
        turned = so3.exp(0.01 * angles[:, None] * [0.0, 0.0, 1.0]) @ detection.points[..., None]
        assert np.abs(on_face(turned[..., 0], T)[:, 2]).max() < 1e-9
        stated = np.arctan2(detection.edges[:, 0, 1], detection.edges[:, 0, 0])
        edge = so3.exp(0.01 * stated[:, None] * [0.0, 0.0, 1.0]) @ detection.edges[:, 0, :, None]
        n, t = T[:3, 2], T[:3, 3]
        reached = (n @ t / (edge[..., 0] @ n))[:, None] * edge[..., 0]
        assert (np.abs(on_face(reached, T)[:, 0]) < HALF[0] + 0.02).all()


def test_each_ring_has_its_bias_and_elevation(world: World) -> None:
    bias = tuple(np.linspace(-0.02, 0.02, RINGS).tolist())
    elevations = np.radians(np.linspace(-12.0, 8.0, RINGS))

    def rings(detection: PlanePatch | Segment) -> Index:
        return np.asarray(np.abs(np.arcsin(detection.directions[:, 2:]) - elevations).argmin(axis=1))

    for _, detection, T in beams(world, ModelErrors(scanners={"lidar": ScannerErrors(ring_bias=bias)}), "lidar"):
        assert range_errors(detection, T)[0] == pytest.approx(np.array(bias)[rings(detection)], abs=1e-9)
    tilted = ScannerErrors(ring_elevation=(0.002,) * RINGS)
    for _, detection, T in beams(world, ModelErrors(scanners={"lidar": tilted}), "lidar"):
        assert np.abs(range_errors(detection, T)[0]).max() > 1e-5
        # Upwards is towards z.
        side = np.cross([0.0, 0.0, 1.0], detection.directions)
        axes = -side / np.linalg.norm(side, axis=1)[:, None]
        raised = so3.exp(0.002 * axes) @ detection.points[..., None]
        assert np.abs(on_face(raised[..., 0], T)[:, 2]).max() < 1e-9


def test_a_bumped_sensor_has_another_pose_afterwards(world: World) -> None:
    bump = Bump(after=0.4, translation=(0.02, 0.0, 0.0), rotation=(0.0, 0.0, 0.05))
    errors = ModelErrors(scanners={"laser_front": ScannerErrors(bump=bump)})
    _, before = simulate(world, ModelErrors())
    step = se3.pose(so3.exp(np.array(bump.rotation)), np.array(bump.translation))
    after = simulate(world, errors)[1]
    assert after.T_root_sensor["laser_front"] == pytest.approx(before.T_root_sensor["laser_front"] @ step)
    first = round(0.4 * len(before.boards))
    for capture, detection, T in beams(world, errors, "laser_front"):
        T_at_time = T if capture >= first else step @ T
        assert np.abs(range_errors(detection, T_at_time)[0]).max() < 1e-9


def test_a_drifting_sensor_turns_steadily(world: World) -> None:
    drift = Bump(after=0.0, duration=1.0, rotation=(0.0, 0.0, 0.05))
    errors = ModelErrors(scanners={"laser_front": ScannerErrors(bump=drift)})
    count = len(simulate(world, errors)[1].boards)
    for capture, detection, T_at_end in beams(world, errors, "laser_front"):
        rest = np.array([0.0, 0.0, 0.05 * (1 - capture / count)])
        T = se3.pose(so3.exp(rest), np.zeros(3)) @ T_at_end
        assert np.abs(range_errors(detection, T)[0]).max() < 1e-9


def test_beams_on_dark_tags_are_longer(world: World) -> None:
    for _, detection, T in beams(world, ModelErrors(BoardErrors(tag_range_bias=0.01)), "lidar"):
        error, true = range_errors(detection, T)
        at = on_face(true[:, None] * detection.directions, T)[:, :2]
        on_tag = np.zeros(len(at), dtype=bool)
        for tag in BOARD.tags:
            on_tag |= (np.abs(at - tag.center) < tag.size / 2).all(axis=1)
        assert 0.1 < on_tag.mean() < 0.9
        assert error == pytest.approx(0.01 * on_tag, abs=1e-9)


def test_a_trembling_board_differs_from_message_to_message(world: World) -> None:
    board = BoardErrors(tremor=0.001)
    offsets = []
    for seed in range(10):
        _, captured, truth = simulate_detections(world, seed, EXACT, ModelErrors(board))
        for capture, (detection,) in captured.detections["lidar"].items():
            assert isinstance(detection, PlanePatch)
            points = on_face(detection.points, poses(truth, "lidar")[capture])
            sweeps = points[:, 2].reshape(EXACT.scans_per_hold, -1)
            assert np.ptp(sweeps, axis=1) == pytest.approx(0.0, abs=1e-9)
            offsets.append(sweeps[:, 0])
    first, second = np.array(offsets).T
    assert first.std() == pytest.approx(0.001, rel=0.25)
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.35


def test_a_late_sensor_measures_a_moving_board_where_it_is_afterwards(world: World) -> None:
    moving = BoardErrors(speed=0.1)
    in_time = simulate(world, ModelErrors(moving))
    late = simulate(world, ModelErrors(moving, cameras={"camera": CameraErrors(delay=0.05)}))
    for (captured, truth), moved in ((in_time, 0.0), (late, 0.005)):
        for capture, (detection,) in captured.detections["camera"].items():
            assert isinstance(detection, BoardCorners)
            error = se3.difference(detection.T_camera_board, poses(truth, "camera")[capture])
            assert np.linalg.norm(error[:3]) == pytest.approx(moved, abs=1e-5)
            assert np.linalg.norm(error[3:]) < 1e-5


def test_errors_of_sensors_that_do_not_exist_are_refused(world: World) -> None:
    for wrong in (
        ModelErrors(cameras={"laser_front": CameraErrors()}),
        ModelErrors(scanners={"laser_up": ScannerErrors()}),
        ModelErrors(scanners={"lidar": ScannerErrors(ring_bias=(0.01,))}),
        ModelErrors(scanners={"laser_front": ScannerErrors(ring_elevation=(0.01,))}),
        ModelErrors(scanners={"lidar": ScannerErrors(angle_scale=0.01)}),
    ):
        with pytest.raises(InputError, match=r"no such|rings|2-D"):
            simulate(world, wrong)


def test_the_size_of_a_board_does_not_move_its_print() -> None:
    board = Board(size=(1.2, 0.8), tags=BOARD.tags[:1])
    wide = BoardErrors(size=(0.02, 0.01))
    assert wide.true_size(board) == pytest.approx((1.22, 0.81))
    assert np.array_equal(wide.true_landmarks(board).corners, BoardErrors().true_landmarks(board).corners)
