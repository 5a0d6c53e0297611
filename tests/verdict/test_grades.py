"""Grades of poses, the words for them, and sensors whose residuals or poses are in question."""

from collections.abc import Sequence

import numpy as np
import pytest

from calgraph.config import Tolerance
from calgraph.config.settings import VerdictSettings
from calgraph.geometry import Array, se3, so3
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.result import Verdict
from calgraph.result.finding import Finding
from calgraph.verdict.grades import (
    axis_names,
    collect_findings,
    find_ambiguous_poses,
    find_inconsistent_sensors,
    grade_pose,
    max_good_stddev,
    merge_reasons,
)

TOLERANCE = Tolerance(translation=0.04, rotation=1.0)
GOOD = np.array([0.01, 0.01, 0.01, 0.004, 0.004, 0.004])
TO_THE_SIDE = se3.pose(so3.exp(np.array([0, 0, np.pi / 2])), np.zeros(3))
"""T_root_sensor of a sensor whose x axis is the root's y axis."""


def grade(
    stddev: Array,
    kind: str = "lidar3d",
    T_root_sensor: Array | None = None,
    ambiguity: float = 0.0,
    contradictions: Sequence[str] = (),
) -> Verdict:
    """With standard deviations (6,) along and about the root's axes."""
    T = np.eye(4) if T_root_sensor is None else T_root_sensor
    covariance = np.diag(np.square(stddev))
    return grade_pose(
        "top",
        kind,
        T,
        covariance,
        contradictions,
        ambiguity,
        tolerance=TOLERANCE,
        data="boards",
        advice="move",
        settings=VerdictSettings(),
    )


def with_axis(axis: int, stddev: float) -> Array:
    return np.where(np.arange(6) == axis, stddev, GOOD)


def pair(a: str, b: str, angle: float = 0.0, normalized_rms: float = 1.0) -> PairwiseEstimate:
    nothing = np.zeros((0, 3), dtype=np.intp), np.zeros(0, dtype=np.bool_), np.zeros(0)
    return PairwiseEstimate(a, b, np.eye(4), np.eye(6), *nothing, angle, normalized_rms)


def test_small_standard_deviations_are_good() -> None:
    assert grade(GOOD) == Verdict("good")


@pytest.mark.parametrize(
    ("axis", "limit"),
    [(k, 0.04 / 1.959964) for k in range(3)] + [(k, np.radians(1.0) / 1.959964) for k in range(3, 6)],
)
def test_good_axes_are_within_the_tolerance_with_95_percent(axis: int, limit: float) -> None:
    assert max_good_stddev(TOLERANCE, VerdictSettings())[axis] == pytest.approx(limit)
    assert grade(with_axis(axis, 0.99 * limit)).grade == "good"
    assert grade(with_axis(axis, 1.01 * limit)).grade == "weak"


@pytest.mark.parametrize(
    ("axis", "limit"), [(k, 0.2) for k in range(3)] + [(k, np.radians(10)) for k in range(3, 6)]
)
def test_limits_of_unobservable_axes(axis: int, limit: float) -> None:
    assert grade(with_axis(axis, 0.99 * limit)).grade == "weak"
    assert grade(with_axis(axis, 1.01 * limit)).grade == "unobservable"


def test_another_confidence_allows_other_standard_deviations() -> None:
    limits = max_good_stddev(TOLERANCE, VerdictSettings(tolerance_confidence=0.99))
    np.testing.assert_allclose(limits, TOLERANCE.limits / 2.575829, rtol=1e-6)


def test_a_weak_axis_is_named_with_its_error_and_the_tolerance() -> None:
    for stddev, kind, words in (
        (with_axis(2, 0.035), "lidar3d", "height (z) ±68.6 mm (95 %) of top exceeds the tolerance of 40 mm"),
        (with_axis(2, 0.035), "camera", "depth (z) ±68.6 mm (95 %) of top exceeds the tolerance of 40 mm"),
        (
            with_axis(3, np.radians(1.2)),
            "lidar3d",
            "roll (about x) ±2.35° (95 %) of top exceeds the tolerance of 1°",
        ),
        (
            [0.035, 0.01, 0.03, 0.004, 0.004, np.radians(1.2)],
            "lidar3d",
            "forward (x) ±68.6 mm, height (z) ±58.8 mm, yaw (about z) ±2.35° (95 %) of top exceed the tolerance "
            "of 40 mm and 1°",
        ),
    ):
        assert grade(np.array(stddev), kind) == Verdict("weak", f"{words}; move")


@pytest.mark.parametrize(
    ("T_root_sensor", "words"),
    [
        (TO_THE_SIDE, "sideways (y)"),
        (se3.inverse(TO_THE_SIDE), "sideways (y)"),
        # The sensor's x is the root's y, its y the root's z, and its z the root's x.
        (se3.pose(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.zeros(3)), "height (z)"),
    ],
)
def test_axes_are_those_of_the_sensor(T_root_sensor: Array, words: str) -> None:
    """The covariance is in the root's axes: its x axis is weak."""
    assert grade(with_axis(0, 0.035), T_root_sensor=T_root_sensor) == Verdict(
        "weak", f"{words} ±68.6 mm (95 %) of top exceeds the tolerance of 40 mm; move"
    )


def test_unobservable_axes_are_listed_before_weak_ones() -> None:
    assert grade(with_axis(1, 0.3)).reason == "sideways (y) of top is not observable from these boards; move"
    several = np.array([0.3, 0.03, 0.3, 1.0, 0.001, 0.001])
    assert grade(several) == Verdict(
        "unobservable",
        "forward (x), height (z) and roll (about x) of top are not observable from these boards; "
        "beyond the tolerance of 40 mm: sideways (y) ±58.8 mm (95 %); move",
    )


def test_an_ambiguous_pose_is_unobservable() -> None:
    verdict = grade(GOOD, ambiguity=np.radians(172))
    assert verdict == Verdict("unobservable", "a pose rotated by 172° fits equally well; move")


def test_an_inconsistent_pose_is_weak_at_best() -> None:
    for stddev, expected in (
        (GOOD, Verdict("weak", "residuals are large")),
        (
            with_axis(0, 0.03),
            Verdict(
                "weak",
                "residuals are large; forward (x) ±58.8 mm (95 %) of top exceeds the tolerance of 40 mm; move",
            ),
        ),
        (
            with_axis(0, 0.3),
            Verdict(
                "unobservable", "forward (x) of top is not observable from these boards; residuals are large; move"
            ),
        ),
    ):
        covariance = np.diag(np.square(stddev))
        found = grade_pose(
            "top",
            "lidar3d",
            np.eye(4),
            covariance,
            ["residuals are large"],
            tolerance=TOLERANCE,
            data="boards",
            advice="move",
            settings=VerdictSettings(),
        )
        assert found == expected


def test_axes_of_cameras_are_optical() -> None:
    assert axis_names("camera")[2] == "depth (z)"
    assert axis_names("lidar2d") == axis_names("lidar3d")
    assert axis_names("lidar2d")[0] == "forward (x)"


def test_a_scanner_is_ambiguous_if_all_its_pairs_with_planes_are() -> None:
    """Pairs of two 2-D scanners do not count; the smallest angle is reported."""
    kinds = {"low": "lidar2d", "high": "lidar2d", "camera": "camera", "top": "lidar3d"}
    pairs = [
        pair("camera", "low", 3.0),
        pair("low", "top", 2.0),
        pair("low", "high", 0.0),
        pair("camera", "top", 1.0),
    ]
    assert find_ambiguous_poses(kinds, pairs) == {"low": 2.0}
    assert find_ambiguous_poses(kinds, [*pairs, pair("high", "top", 1.5)]) == {"low": 2.0, "high": 1.5}
    assert find_ambiguous_poses(kinds, [*pairs, pair("top", "low", 0.0)]) == {}


def test_a_sensor_is_inconsistent_if_the_residuals_of_all_its_pairs_are_large() -> None:
    kinds = {"lidar": "lidar3d", "camera": "camera", "laser": "lidar2d"}
    pairs = [
        pair("lidar", "camera", normalized_rms=3.6),
        pair("camera", "laser", normalized_rms=4.4),
        pair("lidar", "laser", normalized_rms=2.9),
    ]
    assert find_inconsistent_sensors("lidar", kinds, pairs, 3.0) == {
        "camera": "camera residuals against all other sensors are 4 times the expected noise: "
        "check its intrinsics, and the sizes of the printed tags or squares"
    }
    assert find_inconsistent_sensors("lidar", kinds, pairs, 3.7) == {}


def test_of_an_inconsistent_root_all_sensors_are_inconsistent() -> None:
    kinds = {"lidar": "lidar3d", "camera": "camera", "laser": "lidar2d"}
    pairs = [pair("lidar", "camera", normalized_rms=5.0), pair("camera", "laser", normalized_rms=1.0)]
    found = find_inconsistent_sensors("lidar", kinds, pairs, 3.0)
    assert set(found) == {"camera", "laser"}
    assert all(
        reason.startswith("lidar residuals against all other sensors are 5 times") for reason in found.values()
    )


def test_a_small_angle_to_another_pose_makes_a_scanner_ambiguous() -> None:
    assert find_ambiguous_poses({"top": "lidar3d", "low": "lidar2d"}, [pair("top", "low", 0.1)]) == {"low": 0.1}


def test_a_sensor_has_each_reason_once_and_in_order() -> None:
    merged = merge_reasons({"top": "moved", "low": "bent"}, {"top": ["noisy"]}, {"top": "moved"})
    assert merged == {"top": ["moved", "noisy"], "low": ["bent"]}


def test_findings_make_the_sensors_weak_that_they_name() -> None:
    findings = [Finding("late", ("a",)), Finding("upside-down"), Finding("bent", ("a", "b"))]
    assert collect_findings(findings) == {"a": ["late", "bent"], "b": ["bent"]}


@pytest.mark.parametrize(
    ("stddev", "reason"),
    [
        (GOOD, "late; bent; noisy; and 1 more, among the remarks"),
        (
            with_axis(0, 0.03),
            "late; bent; forward (x) ±58.8 mm (95 %) of top exceeds the tolerance of 40 mm; "
            "and 2 more, among the remarks; move",
        ),
        (
            with_axis(0, 0.3),
            "forward (x) of top is not observable from these boards; late; bent; and 2 more, among the remarks; "
            "move",
        ),
    ],
)
def test_a_verdict_states_three_reasons_and_the_number_of_the_others(stddev: Array, reason: str) -> None:
    assert grade(stddev, contradictions=("late", "bent", "noisy", "lost")).reason == reason


def test_a_remedy_of_several_reasons_is_stated_once_after_the_last() -> None:
    reasons = ("late; set clocks", "bent; set clocks")
    assert grade(GOOD, contradictions=reasons).reason == "late; bent; set clocks"
