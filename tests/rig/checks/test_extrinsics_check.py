"""The audit of given extrinsics: what is right passes, what moved fails, what cannot be told is said to be so."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from bundle_scenes import Scene, scene
from calgraph.config import Tolerance
from calgraph.config.settings import VerdictSettings
from calgraph.errors import InputError
from calgraph.geometry import Array, se3
from calgraph.result import Calibration, CaptureRow, ExtrinsicsFile, Remedy, SensorPose, Verdict
from calgraph.result.frame_tree import FrameLink, FrameTree
from calgraph.rig.bundle.bundle_solver import minimize_bundle
from calgraph.rig.bundle.covariances import pose_covariance
from calgraph.rig.bundle.observations import relative_poses
from calgraph.rig.bundle.solution import SolvedBundle
from calgraph.rig.verification import compare_rig_poses
from calgraph.verdict.comparison import ExtrinsicsComparison
from calgraph.verdict.grades import exceeds_tolerance

TOLERANCE = Tolerance()
SEEDS = 20


def precise() -> Scene:
    """Sensors with a fifth of the usual noise: 24 boards then tell all axes to within the tolerance."""
    exact = scene(("lidar", "camera", "laser", "laser_2"), boards=24).without_bias()
    views = tuple(
        own.update_noise(relative_poses(T, exact.truth.T_root_board), 0.2)
        for own, T in zip(exact.bundle.views, exact.truth.T_root_sensor, strict=True)
    )
    return replace(exact, bundle=replace(exact.bundle, views=views))


EXACT = precise()
NAMES = EXACT.bundle.sensors
KINDS = {"lidar": "lidar3d", "camera": "camera", "laser": "lidar2d", "laser_2": "lidar2d"}


@cache
def calibrated(seed: int | None = None) -> tuple[Calibration, SolvedBundle]:
    """What a calibration finds of boards measured with noise, or without."""
    bundle = EXACT.bundle if seed is None else EXACT.measured(np.random.default_rng(seed))
    solved = minimize_bundle(bundle, EXACT.truth)
    joint = pose_covariance(bundle, solved.state, solved.equations)
    sensors = tuple(
        SensorPose(
            name, None if i == 0 else NAMES[0], f"{name}_frame", KINDS[name],  # type: ignore[arg-type]
            solved.state.T_root_sensor[i], Verdict("good"),
        )
        for i, name in enumerate(NAMES)
    )  # fmt: skip
    boards = np.arange(len(EXACT.truth.T_root_board))
    return Calibration(NAMES[0], sensors, joint_covariance=joint), SolvedBundle(bundle, solved, boards)


def true_poses(moved: str = "", by: Array | None = None) -> ExtrinsicsFile:
    """The truth as a file has it, one sensor moved along its own axes by a step (6,)."""
    T = dict(zip(NAMES, EXACT.truth.T_root_sensor, strict=True))
    if by is not None:
        T[moved] = T[moved] @ se3.retract(np.eye(4), by)
    above = {f"{n}_frame": FrameLink("lidar_frame", se3.inverse(T["lidar"]) @ T[n]) for n in NAMES[1:]}
    return ExtrinsicsFile(Path("robot.urdf"), FrameTree("robot.urdf", above))


def audited(given: ExtrinsicsFile, seed: int = 0, tolerance: Tolerance = TOLERANCE) -> ExtrinsicsComparison:
    return compare_rig_poses(calibrated(seed)[0], None, given, tolerance, settings=VerdictSettings())


def step(axis: int, size: float) -> Array:
    return np.asarray(size * np.eye(6)[axis])


def test_a_rig_that_nobody_touched_passes() -> None:
    # A sensor is significantly off once in a thousand, and even then does not fail.
    outcomes = [audited(true_poses(), seed).outcome for seed in range(SEEDS)]
    assert outcomes.count("pass") >= SEEDS - 2
    assert "fail" not in outcomes


@pytest.mark.parametrize("sensor", NAMES)
@pytest.mark.parametrize(("axis", "size"), [(0, 0.03), (2, -0.03), (4, np.radians(1)), (5, -np.radians(1))])
def test_the_sensor_that_moved_is_the_one_that_fails(sensor: str, axis: int, size: float) -> None:
    result = audited(true_poses(sensor, step(axis, size)), seed=axis % 2)
    assert result.failed == (sensor,)


def test_the_axis_is_named_with_its_size() -> None:
    result = audited(true_poses("laser", step(1, 0.03)))
    laser = next(sensor for sensor in result.sensors if sensor.sensor == "laser")
    assert [axis.axis for axis in laser.axes if axis.outcome == "fail"] == ["sideways (y)"]
    assert laser.axes[1].offset == pytest.approx(0.03, abs=4 * laser.axes[1].stddev)
    assert laser.reason.startswith("sideways (y) +")
    assert laser.reason.endswith("beyond 10.0 mm")


def test_a_moved_root_is_found_from_another_sensor() -> None:
    result = audited(true_poses("lidar", step(0, 0.05)))
    assert (result.reference != "lidar", result.failed) == (True, ("lidar",))


def test_what_moved_within_the_tolerance_is_a_warning() -> None:
    result = audited(true_poses("camera", step(0, 0.008)))
    camera = result.sensors[0]
    assert (camera.sensor, camera.outcome) == ("camera", "warn")
    assert "significant, but within 10.0 mm" in camera.reason


def test_a_larger_tolerance_lets_more_pass() -> None:
    moved = true_poses("camera", step(0, 0.03))
    assert audited(moved).outcome == "fail"
    assert audited(moved, tolerance=Tolerance(translation=0.05)).outcome == "warn"


def uncertain(height: float, used: int = 0) -> Calibration:
    """The true poses, with a standard deviation (m) of the last sensor's height that is far above its others."""
    found, _ = calibrated()
    loose = replace(found.sensors[3], T_root_sensor=EXACT.truth.T_root_sensor[3])
    joint = np.array(found.joint_covariance)
    to_root = EXACT.truth.T_root_sensor[3][:3, :3]
    joint[18:], joint[:, 18:] = 0.0, 0.0
    joint[18:21, 18:21] = to_root @ np.diag([1e-8, 1e-8, height**2]) @ to_root.T
    rows = tuple(CaptureRow(k, 0.0, 1.0, "laser_2", k < used, "") for k in range(used + 1))
    return replace(
        found,
        sensors=(*found.sensors[:3], loose),
        joint_covariance=joint,
        evidence=replace(found.evidence, captures=rows),
    )


def as_file(calibration: Calibration) -> ExtrinsicsFile:
    """The poses of a calibration as a file with covariances."""
    above = {s.name: FrameLink("lidar", s.T_root_sensor) for s in calibration.sensors[1:]}
    tree = FrameTree("calibration.yaml", above)
    return ExtrinsicsFile(Path("calibration.yaml"), tree, calibration=calibration)


def test_what_the_captures_do_not_determine_is_stated_with_its_limit() -> None:
    result = compare_rig_poses(uncertain(0.12), None, true_poses(), TOLERANCE, settings=VerdictSettings())
    assert result.outcome == "warn"
    assert result.sensors[2].reason == "too uncertain: height (z) σ 120 mm (limit 5.1 mm)"


@pytest.mark.parametrize(("height", "outcome"), [(0.0050, "pass"), (0.0052, "warn")])
def test_what_is_good_enough_for_a_verdict_decides(height: float, outcome: str) -> None:
    """Of a tolerance of 10 mm: 1.96 standard deviations of 5.1 mm."""
    found = uncertain(height)
    result = compare_rig_poses(found, None, true_poses(), TOLERANCE, settings=VerdictSettings())
    assert exceeds_tolerance(
        found["laser_2"].T_root_sensor, found["laser_2"].covariance, TOLERANCE, VerdictSettings()
    ) == (outcome == "warn")
    assert result.sensors[2].outcome == outcome


def test_an_offset_beyond_the_tolerance_that_is_not_significant_is_not_a_pass() -> None:
    given = true_poses("laser_2", step(2, 0.012))
    result = compare_rig_poses(uncertain(0.005), None, given, TOLERANCE, settings=VerdictSettings())
    assert [axis.outcome for axis in result.sensors[2].axes] == ["pass", "pass", "warn", "pass", "pass", "pass"]
    assert result.sensors[2].reason == "height (z) +12.0 mm (σ 5.0 mm): beyond 10.0 mm, but not significant"


def test_the_sum_of_both_uncertainties_is_named_where_either_alone_suffices() -> None:
    found = uncertain(0.004, used=10)
    result = compare_rig_poses(found, None, as_file(found), TOLERANCE, settings=VerdictSettings())
    assert result.sensors[2].reason == (
        "too uncertain: height (z) σ 5.66 mm (limit 5.1 mm); "
        "the recording alone is accurate enough, but the given pose is uncertain, too"
    )


def test_the_captures_are_stated_that_decide_beside_the_uncertainty_of_the_file() -> None:
    """16 mm² of each; 26.03 are allowed, so that the recording's have to become 10.03: of 10 captures, 16."""
    found = uncertain(0.004, used=10)
    result = compare_rig_poses(found, None, as_file(found), TOLERANCE, settings=VerdictSettings())
    assert result.remedy == (
        "at least 16 captures of laser_2 like the 10 that were used, or a tolerance of 11.1 mm and 0.3°"
    )


@pytest.mark.parametrize("exact", [True, False])
def test_a_remedy_of_the_recording_is_none_of_an_uncertain_file(exact: bool) -> None:
    found = uncertain(0.006 if exact else 0.004, used=10)
    remedy = Remedy("record more", "laser_2", "height (z)", "m", 0.006, 0.003, suffices=True)
    found = replace(found, evidence=replace(found.evidence, remedies=(remedy,)))
    given = true_poses() if exact else as_file(found)
    result = compare_rig_poses(found, None, given, TOLERANCE, settings=VerdictSettings())
    assert result.remedy.startswith(f"{remedy}, or a" if exact else "at least 16 captures of laser_2")


def test_a_remedy_is_none_in_the_frame_of_another_sensor() -> None:
    """Standard deviations there are others than those that it states."""
    found = uncertain(0.006, used=10)
    remedy = Remedy("record more", "laser_2", "height (z)", "m", 0.006, 0.003, suffices=True)
    found = replace(found, evidence=replace(found.evidence, remedies=(remedy,)))
    given = true_poses("lidar", step(0, 0.05))
    result = compare_rig_poses(found, None, given, TOLERANCE, settings=VerdictSettings())
    assert result.reference != "lidar"
    assert "record more" not in result.remedy
    assert result.remedy


def test_the_tolerance_that_the_remedy_states_decides() -> None:
    found = uncertain(0.004)
    tolerance = Tolerance(translation=0.0111, rotation=0.3)
    assert compare_rig_poses(found, None, as_file(found), tolerance, settings=VerdictSettings()).remedy == ""


def test_a_file_that_is_too_uncertain_itself_is_no_matter_of_captures() -> None:
    given = as_file(uncertain(0.006))
    result = compare_rig_poses(uncertain(0.001), None, given, TOLERANCE, settings=VerdictSettings())
    assert result.remedy == (
        "no recording decides laser_2, as the given pose itself is too uncertain, or a tolerance of 12 mm and 0.3°"
    )


def test_captures_far_from_a_decision_are_not_counted() -> None:
    result = compare_rig_poses(uncertain(0.12), None, true_poses(), TOLERANCE, settings=VerdictSettings())
    assert result.remedy == "captures that determine laser_2 in other directions than these"


def test_axes_that_the_verdict_names_are_not_named_twice() -> None:
    found = uncertain(0.02)
    weak = replace(found.sensors[3], verdict=Verdict("weak", "height (z) ±39.2 mm exceeds 10 mm"))
    calibration = replace(found, sensors=(*found.sensors[:3], weak))
    result = compare_rig_poses(calibration, None, true_poses(), TOLERANCE, settings=VerdictSettings())
    assert result.sensors[2].reason == "height (z) ±39.2 mm exceeds 10 mm"


def test_axes_that_are_sure_only_together_fail_together() -> None:
    """Far off along a direction that is well known, though neither of its axes is."""
    found, _ = calibrated()
    joint = np.array(found.joint_covariance)
    own = EXACT.truth.T_root_sensor[3][:3, :3]
    along = own @ np.array([1, 1, 0]) / np.sqrt(2)
    joint[18:21, 18:21] += 0.1**2 * np.outer(along, along)
    result = compare_rig_poses(
        replace(found, joint_covariance=joint),
        None,
        true_poses("laser_2", np.array([0.03, -0.03, 0, 0, 0, 0])),
        TOLERANCE,
        settings=VerdictSettings(),
    )
    assert [axis.outcome for axis in result.sensors[2].axes] == ["fail", "fail", "pass", "pass", "pass", "pass"]


def test_measurements_fit_the_given_pose_worse_where_it_is_wrong() -> None:
    result = compare_rig_poses(
        *calibrated(0), true_poses("laser", step(0, 0.05)), TOLERANCE, settings=VerdictSettings()
    )
    misfits = {sensor.sensor: sensor.misfit for sensor in result.sensors}
    camera, laser = misfits["camera"], misfits["laser"]
    assert camera is not None
    assert laser is not None
    assert (camera.unit, laser.unit) == ("px", "m")
    assert laser.found == pytest.approx(0.012 / 5, rel=0.1)
    assert laser.given > 2 * laser.found


def test_covariances_of_a_given_calibration_count() -> None:
    """Two calibrations of one rig differ by the noise of both."""
    distances = []
    for seed in range(SEEDS):
        found, before = calibrated(seed)[0], calibrated((seed + 1) % SEEDS)[0]
        distances += [
            sensor.distance**2
            for sensor in compare_rig_poses(
                found, None, as_file(before), TOLERANCE, settings=VerdictSettings()
            ).sensors
        ]
    # 60 squared distances with six degrees of freedom each, those of one run, and of neighbours, correlated.
    assert 4.5 < np.mean(distances) < 7.5


def test_a_sensor_that_the_file_lacks_is_a_warning_by_name() -> None:
    given = true_poses()
    less = {frame: hanging for frame, hanging in given.tree.links.items() if frame != "camera_frame"}
    result = audited(replace(given, tree=FrameTree("robot.urdf", less)))
    assert result.sensors[0].outcome == "warn"
    assert result.sensors[0].reason == "robot.urdf has neither a frame camera_frame nor one called camera"


def test_a_file_without_the_root_is_refused() -> None:
    less = {"camera_frame": FrameLink("base", np.eye(4))}
    with pytest.raises(InputError, match="has no frame 'lidar_frame', nor one called lidar"):
        audited(ExtrinsicsFile(Path("robot.urdf"), FrameTree("robot.urdf", less)))


def test_a_doubtful_calibration_warns_of_what_it_doubts() -> None:
    found, adjusted = calibrated()
    doubted = replace(found.sensors[1], verdict=Verdict("weak", "check the focal length"))
    result = compare_rig_poses(
        replace(found, sensors=(found.sensors[0], doubted, *found.sensors[2:])),
        adjusted,
        true_poses(),
        TOLERANCE,
        settings=VerdictSettings(),
    )
    assert (result.sensors[0].outcome, result.sensors[0].reason) == ("warn", "check the focal length")


def test_a_moved_sensor_fails_although_its_calibration_is_weak() -> None:
    found, adjusted = calibrated()
    weak = replace(found.sensors[1], verdict=Verdict("weak", "check the focal length"))
    calibration = replace(found, sensors=(found.sensors[0], weak, *found.sensors[2:]))
    result = compare_rig_poses(
        calibration, adjusted, true_poses("camera", step(2, 0.05)), TOLERANCE, settings=VerdictSettings()
    )
    assert result.failed == ("camera",)
    assert "check the focal length" not in result.sensors[0].reason


def test_sensors_that_captures_do_not_tie_are_warnings() -> None:
    found, adjusted = calibrated()
    result = compare_rig_poses(
        replace(found, evidence=replace(found.evidence, unconnected={"sonar": "saw nothing"})),
        adjusted,
        true_poses(),
        TOLERANCE,
        settings=VerdictSettings(),
    )
    assert (result.sensors[-1].sensor, result.sensors[-1].outcome) == ("sonar", "warn")


def test_residuals_are_infinite_where_given_poses_put_boards_behind_a_camera() -> None:
    result = compare_rig_poses(
        *calibrated(0), true_poses("camera", step(4, np.pi)), TOLERANCE, settings=VerdictSettings()
    )
    residuals = [result.misfit, *(sensor.misfit for sensor in result.sensors)]
    assert [one and one.given for one in residuals] == [np.inf] * 4
    assert all(one and one.found < 0.1 for one in residuals)


def test_the_uncertainty_of_exact_poses_is_their_rounding() -> None:
    """1e-6 m and rad."""
    found, _ = calibrated()
    result = compare_rig_poses(
        replace(found, joint_covariance=np.zeros((24, 24))),
        None,
        true_poses(),
        TOLERANCE,
        settings=VerdictSettings(),
    )
    np.testing.assert_allclose([axis.stddev for axis in result.sensors[0].axes], 1e-6)
