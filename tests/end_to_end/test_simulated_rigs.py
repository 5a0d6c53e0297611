"""Whole stories on simulated robots: odd mounts, odd robots and odd recordings, judged by the truth."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from calgraph.config import Board, Checkerboard, Rig
from calgraph.config.settings import RigStart
from calgraph.parallel.engine import Processes
from calgraph.recording import MessageRecording
from calgraph.recording.recording import JoinedRecording
from calgraph.result import Calibration
from calgraph.rig.capture_collection import collect_captures
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.sensors import LaserScan, Message
from calgraph.simulation import (
    CameraOptions,
    GroundTruth,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
)
from calgraph.simulation.rig_simulation import TRIGGER_TOPIC
from simulated_rigs import (
    SimulatedRecording,
    alter_messages,
    build_recording,
    calibrate,
    keep_decoded,
    pose_errors,
    simulate_scenario,
)

pytestmark = pytest.mark.slow

NO_CAMERA = CameraOptions(count=0)
NO_LASER = LaserOptions(count=0)
NO_SPINNING = SpinningOptions(count=0)
CAMERA = CameraOptions(width=560, height=420, texels_per_mm=1.0, rate=2.0)
LASERS = LaserOptions(count=2, rate=4.0, resolution=0.5)
MULTIBEAM = MultibeamOptions(count=1, rate=4.0, rings=32, resolution=0.8)
SCENARIO = RigScenario(
    camera=CAMERA,
    laser=LASERS,
    spinning=NO_SPINNING,
    multibeam=MULTIBEAM,
    bearings=(-60, -40, -30, -20, -10, -5, 0, 10, 20, 30, 40, 60),
    radii=(1.8,),
    samples=1,
    clutter=4,
    move_time=0.4,
)
CHECKERBOARD = Board(size=(1.0, 0.8), pattern=Checkerboard(kind="checkerboard", columns=8, rows=6, square=0.1))
LASER = "/laser_front/scan"
Staged = tuple[Rig, SimulatedRecording, GroundTruth]


def scenario(**knobs: object) -> RigScenario:
    return SCENARIO.model_copy(update=knobs)


def without(rig: Rig, name: str) -> Rig:
    """The rig without one sensor, which saves its time."""
    return rig.model_copy(update={"sensors": {n: s for n, s in rig.sensors.items() if n != name}})


def board_of(rig: Rig) -> Board:
    return rig.boards[0]


def upside_down(scan: Message) -> Message:
    """The scan of the same scanner turned half about its x axis: its beams run the other way round."""
    assert isinstance(scan, LaserScan)
    return replace(scan, ranges=scan.ranges[::-1].copy())


def flat(scan: Message, at: float) -> Message:
    """The scan with one range everywhere."""
    assert isinstance(scan, LaserScan)
    return replace(scan, ranges=np.full_like(scan.ranges, at))


def assert_true(
    calibration: Calibration, truth: GroundTruth, millimetres: float = 25.0, degrees: float = 1.0
) -> None:
    """A dozen captures: every sensor near the truth, and no error beyond five standard deviations."""
    for name, error in pose_errors(calibration, truth).items():
        assert 1000 * np.linalg.norm(error[:3]) < millimetres, name
        assert np.degrees(np.linalg.norm(error[3:])) < degrees, name
        assert np.all(np.abs(error) < 5 * np.sqrt(np.diag(calibration[name].covariance))), name


@pytest.fixture(scope="module")
def recorded_rig() -> Staged:
    rig, recording, truth = simulate_scenario(SCENARIO)
    return rig, keep_decoded(recording), truth


def test_a_rig_that_starts_from_the_consensus_of_all_pairs_ends_the_same(recorded_rig: Staged) -> None:
    rig, recording, _ = recorded_rig
    captured = collect_captures(rig, recording, RigOptions(), np.random.default_rng(0))
    starts: tuple[RigStart, ...] = ("tree", "consensus")
    along_tree, consensus = (
        solve_problem(
            build_problem_from_captures(rig, captured, RigOptions(start=start), np.random.default_rng(0))
        )
        for start in starts
    )
    for sensor in along_tree.sensors:
        T = consensus[sensor.name].T_root_sensor
        np.testing.assert_allclose(T[:3, 3], sensor.T_root_sensor[:3, 3], atol=2e-4)
        np.testing.assert_allclose(T[:3, :3], sensor.T_root_sensor[:3, :3], atol=2e-4)


def test_camera_lidar_and_scanners_are_found(recorded_rig: Staged) -> None:
    rig, recording, truth = recorded_rig
    calibration = calibrate(rig, recording)
    assert len(calibration.sensors) == 4
    assert_true(calibration, truth)


def test_the_same_seed_gives_the_same_result_in_any_number_of_processes(recorded_rig: Staged) -> None:
    """Scanners only, for time; the last bit counts."""
    rig, recording, _ = recorded_rig
    few = without(rig, "camera")
    messages: dict[str, list[Message]] = {}
    for record in recording.records([*few.topics.values(), TRIGGER_TOPIC]):
        messages.setdefault(record.topic, []).append(record.decode())
    decoded = MessageRecording(messages)
    first, second = (calibrate(few, decoded, RigOptions(seed=7, engine=Processes(jobs))) for jobs in (1, 3))
    for a, b in zip(first.sensors, second.sensors, strict=True):
        np.testing.assert_array_equal(a.T_root_sensor, b.T_root_sensor)
        np.testing.assert_array_equal(a.covariance, b.covariance)


def test_an_upside_down_scanner_is_found(recorded_rig: Staged) -> None:
    """Its beams run the other way round and its z points down."""
    rig, recording, truth = recorded_rig
    turned = alter_messages(recording, LASER, upside_down)
    poses = dict(truth.T_root_sensor)
    poses["laser_front"] = poses["laser_front"] @ np.diag([1.0, -1.0, -1.0, 1.0])
    calibration = calibrate(without(rig, "laser_left"), turned)
    assert_true(calibration, replace(truth, T_root_sensor=poses))


def test_a_scanner_that_never_sees_the_board_is_named_and_the_rest_is_calibrated(recorded_rig: Staged) -> None:
    rig, recording, truth = recorded_rig
    blind = alter_messages(recording, LASER, partial(flat, at=9.0))
    calibration = calibrate(rig, blind)
    assert list(calibration.evidence.unconnected) == ["laser_front"]
    assert "none of 12 captures" in calibration.evidence.unconnected["laser_front"]
    assert_true(calibration, truth)


def test_a_dead_scanner_is_named_and_the_rest_is_calibrated(recorded_rig: Staged) -> None:
    rig, recording, truth = recorded_rig
    dead = alter_messages(recording, LASER, partial(flat, at=np.nan))
    calibration = calibrate(without(rig, "camera"), dead)
    assert list(calibration.evidence.unconnected) == ["laser_front"]
    assert_true(calibration, truth)


def test_tags_that_are_not_on_the_board_leave_only_the_camera_out(recorded_rig: Staged) -> None:
    rig, recording, truth = recorded_rig
    tags = tuple(tag.model_copy(update={"id": tag.id + 10}) for tag in board_of(rig).tags)
    calibration = calibrate(
        rig.model_copy(update={"target": board_of(rig).model_copy(update={"tags": tags})}), recording
    )
    assert "which are not on the board; ids 10 to 12 expected" in calibration.evidence.unconnected["camera"]
    assert_true(calibration, truth)


def test_a_print_of_another_size_is_no_good_camera(recorded_rig: Staged) -> None:
    """Everything printed is 5 % larger than it is: a pose 80 mm off, with small standard deviations."""
    rig, recording, _ = recorded_rig
    tags = tuple(
        tag.model_copy(update={"size": 1.05 * tag.size, "center": (1.05 * tag.center[0], 1.05 * tag.center[1])})
        for tag in board_of(rig).tags
    )
    calibration = calibrate(
        rig.model_copy(update={"target": board_of(rig).model_copy(update={"tags": tags})}), recording
    )
    verdict = calibration["camera"].verdict
    assert verdict.grade != "good"
    assert "the print on the board is" in verdict.reason
    assert "smaller than stated" in verdict.reason


def test_messages_that_arrive_late_or_twice_hardly_change_the_result(recorded_rig: Staged) -> None:
    rig, recording, truth = recorded_rig
    rng = np.random.default_rng(3)
    late = [replace(r, arrival=r.arrival + rng.uniform(0, 1)) for r in [*recording.messages, *recording.messages]]
    calibration = calibrate(without(rig, "camera"), build_recording(late))
    assert {row.capture for row in calibration.evidence.captures} == set(range(12))
    assert_true(calibration, truth, 50, 2)


@pytest.mark.parametrize(
    ("knobs", "count"),
    [
        pytest.param({"root": "camera", "laser": NO_LASER}, 2, id="the camera is the root"),
        pytest.param(
            {"laser": LASERS.model_copy(update={"count": 1}), "multibeam": MultibeamOptions()},
            2,
            id="a camera and a 2-D scanner only",
        ),
        pytest.param(
            {
                "camera": NO_CAMERA,
                "multibeam": MultibeamOptions(),
                "spinning": SpinningOptions(count=1, resolution=1.0, scans_per_degree=0.5),
            },
            3,
            id="a spinning scanner and 2-D scanners",
        ),
        pytest.param(
            {"camera": NO_CAMERA, "trigger": False, "hold_time": 1.6}, 3, id="holds without triggers"
        ),
        pytest.param({"camera": NO_CAMERA, "disturbed": 0.17}, 3, id="two captures disturbed"),
        pytest.param(
            {
                "camera": CameraOptions(
                    count=2, width=560, height=420, model="fisheye", field_of_view=150,
                    distortion=(0.02, -0.01, 0.003, -0.001), rate=2.0, texels_per_mm=1.0,
                ),
                "laser": NO_LASER,
                "board": CHECKERBOARD,
            },
            3,
            id="two fisheye cameras and a checkerboard",
        ),
    ],
)  # fmt: skip
def test_other_robots_are_found(knobs: dict[str, object], count: int) -> None:
    rig, recording, truth = simulate_scenario(scenario(**knobs), seed=2)
    calibration = calibrate(rig, recording)
    assert len(calibration.sensors) == count
    assert_true(calibration, truth, 40, 1.5)


def test_without_a_background_window_the_board_is_found_by_its_shape() -> None:
    rig, recording, truth = simulate_scenario(
        scenario(camera=NO_CAMERA, laser=LASERS.model_copy(update={"count": 1}))
    )
    calibration = calibrate(
        rig.model_copy(update={"capture": rig.capture.model_copy(update={"background": None})}), recording
    )
    assert_true(calibration, truth, 40, 1.5)


def test_two_halves_of_a_recording_are_one(recorded_rig: Staged) -> None:
    rig, recording, truth = recorded_rig
    middle = (recording.start + recording.end) / 2
    halves = [
        build_recording(r for r in recording.messages if (r.arrival < middle) == first) for first in (True, False)
    ]
    with JoinedRecording(halves) as both:
        calibration = calibrate(without(rig, "camera"), both)
    assert_true(calibration, truth)


def test_without_the_filter_an_undisturbed_recording_is_calibrated_too(recorded_rig: Staged) -> None:
    rig, recording, truth = recorded_rig
    calibration = calibrate(without(rig, "camera"), recording, RigOptions(keep="none"))
    assert_true(calibration, truth, 50, 2)


def test_four_captures_do_not_pass_for_a_good_scanner(recorded_rig: Staged) -> None:
    """So few planes fit several poses of a 2-D scanner, one turned by 180 degrees: the verdict has to say so."""
    rig, recording, truth = recorded_rig
    fourth = truth.boards[3].end
    few = build_recording(r for r in recording.messages if r.arrival < fourth + 0.3)
    calibration = calibrate(without(rig, "camera"), few)
    for name, error in pose_errors(calibration, truth).items():
        within = np.all(np.abs(error) < 5 * np.sqrt(np.diag(calibration[name].covariance)))
        assert within or calibration[name].verdict.grade == "unobservable", name


def test_errors_scatter_as_the_covariances_say() -> None:
    """Five robots, two sensors each: mean normalised squared error of a degree of freedom."""
    small = scenario(
        camera=CAMERA.model_copy(update={"width": 400, "height": 300}),
        laser=LASERS.model_copy(update={"count": 1}),
    )
    values = []
    for seed in range(5):
        rig, recording, truth = simulate_scenario(small, seed)
        calibration = calibrate(rig, recording, RigOptions(folds=0))  # which change no pose
        for name, error in pose_errors(calibration, truth).items():
            values.append(error @ np.linalg.solve(calibration[name].covariance, error) / 6)
    assert len(values) == 10
    assert 0.3 < np.mean(values) < 3
