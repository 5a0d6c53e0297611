"""Detections with known noise: what an estimator's errors are compared with has to be exactly what is stated."""

import numpy as np
import pytest
from scipy.stats import chi2

from calgraph.boards.detections import BoardCorners, PlanePatch, Segment
from calgraph.config import Board, Checkerboard, RangeNoise, Rig
from calgraph.config.settings import BoardPairSettings, Settings
from calgraph.geometry import Array, Index, plane, se3
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.pairs.board_pair import estimate_pairs, select_successful
from calgraph.rig.pairs.rig_initialization import initialize_rig
from calgraph.rig.published.hypergraph import solve_hypergraph
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
from ideal_detections import IdealBeams, IdealDetectorOptions, simulate_detections

CAMERA = CameraOptions(width=640, height=480, texels_per_mm=0.5)
COARSE = SpinningOptions(resolution=1.0, scans_per_degree=1 / 6)
SMALL = RigScenario(
    camera=CAMERA,
    laser=LaserOptions(count=2),
    spinning=COARSE,
    bearings=(-20, -10, 0, 10, 20),
    radii=(1.7,),
    background=1.0,
)
NOISELESS = SMALL.model_copy(
    update={
        "laser": LaserOptions(count=2, range_noise=0.0),
        "spinning": COARSE.model_copy(update={"range_noise": 0.0}),
    }
)


@pytest.fixture(scope="module")
def world() -> World:
    return build_world(SMALL, 0, images=False)


def ends(captured: CaptureSet, name: str) -> dict[int, Array]:
    """By capture, the ends of the beams of a scanner on the board."""
    found: dict[int, Array] = {}
    for capture, (detection,) in captured.detections[name].items():
        assert isinstance(detection, PlanePatch | Segment)
        found[capture] = detection.points
    return found


def planes(truth: GroundTruth, name: str) -> Array:
    """``T_sensor_board`` (C, 4, 4) in all captures."""
    T_root_board = np.array([board.T_root_board for board in truth.boards])
    return np.asarray(se3.inverse(truth.T_root_sensor[name]) @ T_root_board)


def whitened_ranges(rig: Rig, captured: CaptureSet, truth: GroundTruth, name: str) -> Array:
    """Differences between measured ranges and those to the true board, in stated standard deviations.

    For scanners whose beams start in their origin.
    """
    surfaces, noise = plane.from_pose(planes(truth, name)), rig.sensors[name].noise
    assert isinstance(noise, RangeNoise)
    whitened = []
    for capture, points in ends(captured, name).items():
        ranges = np.linalg.norm(points, axis=1)
        true = -surfaces[capture, 3] * ranges / (points @ surfaces[capture, :3])
        whitened.append((ranges - true) / noise.range)
    return np.concatenate(whitened)


def whitened_pixels(captured: CaptureSet, truth: GroundTruth, sigma: float) -> Array:
    poses, whitened = planes(truth, "camera"), []
    for capture, (detection,) in captured.detections["camera"].items():
        assert isinstance(detection, BoardCorners)
        projected = captured.cameras["camera"].project(se3.apply(poses[capture], detection.corners_board))
        whitened.append((detection.pixels - projected).ravel() / sigma)
    return np.concatenate(whitened)


def within(values: Array, confidence: float = 0.999) -> bool:
    """Whether the sum of squares of standard normals is one that chance gives."""
    low, high = chi2.interval(confidence, values.size)
    return bool(low < np.sum(values**2) < high)


def test_ranges_have_the_stated_noise(world: World) -> None:
    runs = [simulate_detections(world, seed) for seed in range(3)]
    whitened = np.concatenate([whitened_ranges(*run, "laser_front") for run in runs])
    assert len(whitened) > 3000
    assert within(whitened)


def test_corners_have_the_stated_noise(world: World) -> None:
    options = IdealDetectorOptions(pixel=0.2)
    runs = [simulate_detections(world, seed, options) for seed in range(3)]
    whitened = np.concatenate([whitened_pixels(captured, truth, 0.2) for _, captured, truth in runs])
    assert len(whitened) > 300
    assert within(whitened)


def test_angle_noise_adds_to_ranges_on_an_inclined_board() -> None:
    world = build_world(NOISELESS, 0, images=False)
    options = IdealDetectorOptions(angle=0.001)
    whitened = []
    for seed in range(3):
        _, captured, truth = simulate_detections(world, seed, options)
        surfaces = plane.from_pose(planes(truth, "laser_front"))
        for capture, points in ends(captured, "laser_front").items():
            ranges = np.linalg.norm(points, axis=1)
            d = points / ranges[:, None]
            n, D = surfaces[capture, :3], surfaces[capture, 3]
            slope = D * (np.cross([0.0, 0.0, 1.0], d) @ n) / (d @ n) ** 2
            whitened.append((ranges + D / (d @ n)) / (0.001 * np.abs(slope) + 1e-6))
    assert within(np.concatenate(whitened))


@pytest.mark.parametrize("name", ["lidar", "laser_front"])
def test_beams_without_noise_end_on_the_board(name: str) -> None:
    _, captured, truth = simulate_detections(build_world(NOISELESS, 0, images=False), 0)
    T_board_sensor = se3.inverse(planes(truth, name))
    on_board = [se3.apply(T_board_sensor[capture], points) for capture, points in ends(captured, name).items()]
    flat = np.concatenate(on_board)
    assert np.abs(flat[:, 2]).max() < 1e-9
    assert (np.abs(flat[:, :2]) <= 0.5 * np.array(SMALL.board.size) - 0.02 + 1e-9).all()


def test_every_beam_on_the_board_is_measured_in_every_sweep(world: World) -> None:
    once = simulate_detections(world, 0, IdealDetectorOptions(scans_per_hold=1))[1]
    thrice = simulate_detections(world, 0, IdealDetectorOptions(scans_per_hold=3))[1]
    assert [3 * len(p) for p in ends(once, "lidar").values()] == [len(p) for p in ends(thrice, "lidar").values()]


def test_runs_are_determined_by_their_seed(world: World) -> None:
    first, again, other = (simulate_detections(world, seed)[1] for seed in (3, 3, 4))
    for name in ("lidar", "laser_front"):
        a, b, c = (np.concatenate(list(ends(run, name).values())) for run in (first, again, other))
        assert np.array_equal(a, b)
        assert not np.isclose(a, c, rtol=0, atol=1e-9).all(axis=1).any()


def test_the_stated_noise_does_not_change_the_measurements(world: World) -> None:
    right, right_captured, _ = simulate_detections(world, 0)
    wrong, wrong_captured, _ = simulate_detections(world, 0, IdealDetectorOptions(stated_noise_factor=2.0))
    assert wrong.cameras()["camera"].noise.pixel == 2 * right.cameras()["camera"].noise.pixel
    assert np.array_equal(ends(right_captured, "lidar")[0], ends(wrong_captured, "lidar")[0])


def test_rigs_calibrate_from_detections_alone() -> None:
    world = build_world(RigScenario(camera=CAMERA), 1, images=False)
    rig, captured, truth = simulate_detections(world, 0)
    rng = np.random.default_rng(0)
    estimates = select_successful(
        estimate_pairs(captured.detections, rig.board_size, rng, settings=BoardPairSettings())
    )
    joint = solve_hypergraph(
        initialize_rig(rig.root, estimates, "tree", rng), estimates, captured.detections, settings=Settings()
    )
    errors = np.array([se3.difference(T, truth.T_root_sensor[name]) for name, T in joint.T_root_sensor.items()])
    assert len(errors) == len(rig.sensors)
    assert np.linalg.norm(errors[:, :3], axis=1).max() < 0.010
    assert np.degrees(np.linalg.norm(errors[:, 3:], axis=1)).max() < 0.3


def test_in_disturbed_captures_some_sensors_measure_the_slipped_board() -> None:
    scenario = SMALL.model_copy(update={"samples": 8, "disturbed": 0.25})
    _, captured, truth = simulate_detections(build_world(scenario, 0, images=False), 0)
    off = {True: 0, False: 0}
    surfaces = plane.from_pose(planes(truth, "lidar"))
    for capture, (detection,) in captured.detections["lidar"].items():
        assert isinstance(detection, PlanePatch)
        away = np.abs(plane.distance(surfaces[capture], detection.points).mean())
        off[truth.boards[capture].disturbed] += bool(away > 0.008)
    disturbed = sum(board.disturbed for board in truth.boards)
    assert off[False] == 0
    assert 0 < off[True] < disturbed


def test_a_slip_does_not_change_other_captures() -> None:
    clean, slipped = (
        simulate_detections(build_world(SMALL.model_copy(update={"disturbed": share}), 0, images=False), 0)
        for share in (0.0, 0.4)
    )
    resting = [i for i, board in enumerate(slipped[2].boards) if not board.disturbed]
    for name in ("lidar", "laser_front"):
        assert all(np.array_equal(ends(clean[1], name)[i], ends(slipped[1], name)[i]) for i in resting)


def test_detections_need_no_images(world: World) -> None:
    complete = build_world(SMALL, 0)
    assert not world.renderers
    for name in ("lidar", "laser_front"):
        a, b = (ends(simulate_detections(one, 0)[1], name) for one in (complete, world))
        assert a.keys() == b.keys()
        assert all(np.array_equal(a[i], b[i]) for i in a)


def test_a_board_out_of_view_is_rejected() -> None:
    world = build_world(SMALL.model_copy(update={"bearings": (0, 180)}), 0, images=False)
    _, captured, _ = simulate_detections(world, 0)
    behind = range(SMALL.samples, 2 * SMALL.samples)
    assert not set(behind) & set(captured.detections["camera"])
    assert "image" in captured.rejections[behind[0], "camera"]


def test_a_partly_visible_chessboard_is_rejected() -> None:
    pattern = Checkerboard(kind="checkerboard", columns=8, rows=6, square=0.1)
    board = Board(size=(1.2, 0.9), pattern=pattern)
    narrow = CAMERA.model_copy(update={"field_of_view": 70.0})
    scenario = SMALL.model_copy(update={"board": board, "camera": narrow, "bearings": (-40, 0, 40)})
    _, captured, truth = simulate_detections(build_world(scenario, 0, images=False), 0)
    sizes = {len(found[0].pixels) for found in captured.detections["camera"].values()}  # type: ignore[union-attr]
    assert sizes == {48}
    assert 0 < len(captured.detections["camera"]) < len(truth.boards)


def test_two_rings_are_no_plane() -> None:
    few = MultibeamOptions(count=1, rings=2, lowest=-1.0, highest=1.0)
    scenario = SMALL.model_copy(update={"multibeam": few, "spinning": SpinningOptions(count=0)})
    _, captured, truth = simulate_detections(build_world(scenario, 0, images=False), 0)
    missed = [capture for capture, sensor in captured.rejections if sensor == "lidar"]
    assert (len(captured.detections["lidar"]), len(missed)) == (0, len(truth.boards))


@pytest.mark.parametrize(
    ("name", "beams", "count"),
    [("laser_front", 5, 10), ("laser_front", 4, 0), ("lidar", 20, 10), ("lidar", 19, 0)],
)
def test_some_beams_determine_a_line_and_more_a_plane(
    world: World, name: str, beams: int, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the beams on the board, some at equal distances, in ten captures."""
    on_board = IdealBeams.on_board

    def select(self: IdealBeams, T_sensor_board: Array) -> Index:
        hits = on_board(self, T_sensor_board)
        return np.asarray(hits[np.linspace(0, len(hits) - 1, beams).astype(int)])

    monkeypatch.setattr(IdealBeams, "on_board", select)
    _, captured, _ = simulate_detections(world, 0)
    assert len(captured.detections[name]) == count


def test_three_rings_are_a_plane() -> None:
    """In all captures but the one in which two of them hit the board, with eleven beams."""
    rings = MultibeamOptions(count=1, rings=3, lowest=-1.0, highest=1.0)
    scenario = SMALL.model_copy(update={"multibeam": rings, "spinning": SpinningOptions(count=0)})
    _, captured, truth = simulate_detections(build_world(scenario, 0, images=False), 0)
    missed = {capture: reason for (capture, sensor), reason in captured.rejections.items() if sensor == "lidar"}
    assert missed == {4: "only 11 beams hit the board"}
    assert len(captured.detections["lidar"]) == len(truth.boards) - 1


def test_of_two_beams_at_an_edge_the_first_hits_the_board() -> None:
    _, captured, truth = simulate_detections(build_world(NOISELESS, 0, images=False), 0)
    T_board_sensor, hits = se3.inverse(planes(truth, "laser_front")), []
    for capture, (detection,) in captured.detections["laser_front"].items():
        assert isinstance(detection, Segment)
        assert detection.edges is not None
        origin, rays = T_board_sensor[capture][:3, 3], detection.edges @ T_board_sensor[capture][:3, :3].T
        at = origin - origin[2] / rays[..., 2:] * rays
        hits.append((np.abs(at[..., :2]) < 0.5 * np.array(SMALL.board.size)).all(axis=-1))
    on_board = np.concatenate(hits).mean(axis=0)
    assert on_board[0] >= 0.8
    assert on_board[1] <= 0.2
