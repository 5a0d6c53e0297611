"""Grades of poses, with the reason and what to do about it."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
from scipy.special import ndtri

from calgraph.config import Tolerance
from calgraph.config.settings import VerdictSettings
from calgraph.geometry import Array
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.result import Remedy, Verdict
from calgraph.result.finding import Finding, split_clauses
from calgraph.result.sensor_pose import stddev_along_axes
from calgraph.sensors.kinds import KINDS

LONE_ROOT = Verdict("unobservable", "no other sensor has a pose relative to it")
"""Of a root to which nothing is connected: a good one would claim that something was calibrated."""


def axis_names(kind: str) -> tuple[str, ...]:
    """Names of the six axes of a sensor: along x, y, z, and about them."""
    return KINDS[kind].axes


def grade_pose(
    name: str,
    kind: str,
    T_root_sensor: Array,
    covariance: Array,
    contradictions: Sequence[str] = (),
    ambiguity: float = 0.0,
    *,
    tolerance: Tolerance,
    settings: VerdictSettings,
    data: str = "captures",
    advice: str = "tilt and turn the board more, in different places, where several sensors detect it",
    shares: Mapping[str, Array] = MappingProxyType({}),
    remedy: Remedy | None = None,
) -> Verdict:
    """Grades a pose by its standard deviations along the axes of the sensor.

    A pose is good if nothing contradicts it, and if the error along and about every axis is within the tolerance
    with the probability of the settings.

    Args:
        name: the sensor.
        kind: of sensor; decides what its axes are called.
        T_root_sensor: (4, 4).
        covariance: (6, 6) in the root's fixed axes.
        contradictions: why the pose cannot be good with any covariance, causes before their effects; all but the
            first ones are among the remarks.
        ambiguity: angle to another pose that fits equally well, rad; 0 without one.
        tolerance: the largest acceptable error.
        settings: that probability, and the limits of an unobservable axis.
        data: what the pose was estimated from, in the plural.
        advice: what reduces the standard deviations; the same for all sensors, so that it is printed once.
        shares: (6,) of the variances along and about the axes by source.
        remedy: the best one of a weak pose, which takes the place of advice.

    Returns:
        The verdict, with three reasons at most, and advice; its reason is empty for a good pose.
    """
    stddev = stddev_along_axes(T_root_sensor, covariance)
    axes = axis_names(kind)
    unobservable_stddev = (settings.unobservable_translation_stddev, settings.unobservable_rotation_stddev)
    unobservable = [
        axis for axis, s, limit in zip(axes, stddev, np.repeat(unobservable_stddev, 3), strict=True) if s > limit
    ]
    limits = max_good_stddev(tolerance, settings)
    weak = [i for i in range(6) if stddev[i] > limits[i] and axes[i] not in unobservable]
    errors = ", ".join(
        f"{axes[i]} ±{format_axis_error(tolerance.limits[i] * stddev[i] / limits[i], i)}" for i in weak
    )
    confidence = f"({100 * settings.tolerance_confidence:g} %)"
    allowed = " and ".join(dict.fromkeys(format_axis_error(tolerance.limits[i], i) for i in weak))
    if unobservable or ambiguity:
        reasons = [f"{_join_axes(unobservable, name)} not observable from these {data}"] if unobservable else []
        if ambiguity:
            reasons.append(f"a pose rotated by {np.degrees(ambiguity):.0f}° fits equally well")
        if weak:
            reasons.append(f"beyond the tolerance of {allowed}: {errors} {confidence}")
        stated, more = select_reasons(contradictions, len(reasons))
        return Verdict("unobservable", _join([*reasons, *stated, *more, advice]))
    stated, more = select_reasons(contradictions, 1 if weak else 0)
    if weak:
        exceed = "exceeds" if len(weak) == 1 else "exceed"
        error = f"{errors} {confidence} of {name} {exceed} the tolerance of {allowed}"
        worst = max(weak, key=lambda i: stddev[i] / limits[i])
        largest = describe_largest(shares, worst, axes[worst] if len(weak) > 1 else "it")
        advised = advice if remedy is None else describe_remedy(remedy, tolerance, limits)
        return Verdict("weak", _join([*stated, error, *largest, *more, advised]))
    return Verdict("weak", _join([*stated, *more])) if contradictions else Verdict("good")


_LARGEST = "the largest source"
# Share of a variance with which the largest source is named alone; otherwise this many are.
_LARGE_SHARE, _MAX_SOURCES = 0.5, 2


def describe_largest(shares: Mapping[str, Array], axis: int, what: str) -> list[str]:
    """The sources of the largest shares in the variance of an axis, as a clause."""
    if not shares:
        return []
    largest = sorted(shares, key=lambda source: -shares[source][axis])[:_MAX_SOURCES]
    count = 1 if shares[largest[0]][axis] >= _LARGE_SHARE else len(largest)
    named = (f"{source} ({100 * shares[source][axis]:.0f} %)" for source in largest[:count])
    return [f"{_LARGEST}{'s' * (count > 1)} of {what}: {', '.join(named)}"]


def names_sources(clause: str) -> bool:
    """Whether a clause of a verdict is from :func:`describe_largest`."""
    return clause.startswith(_LARGEST)


def describe_remedy(remedy: Remedy, tolerance: Tolerance, limits: Array) -> str:
    """A remedy, and the error that it leaves with the confidence of verdicts."""
    axis = 0 if remedy.unit == "m" else 3
    left = format_axis_error(tolerance.limits[axis] * remedy.expected / limits[axis], axis)
    return f"{remedy.action}: {remedy.axis} ±{left}" + ("" if remedy.suffices else ", not enough alone")


# Most reasons that a verdict states: what causes it comes first, and more are consequences.
_MAX_REASONS = 3


def select_reasons(
    reasons: Sequence[str], others: int = 0, where: str = "among the remarks"
) -> tuple[Sequence[str], list[str]]:
    """The first reasons beside a number of others, and a clause on how many there are more, and where."""
    stated = max(_MAX_REASONS - others, 0)
    more = len(reasons) - stated
    return reasons[:stated], [f"and {more} more, {where}"] if more > 0 else []


def _join(reasons: Sequence[str]) -> str:
    """The clauses of reasons as one text; a remedy that several of them have stands once, after the last."""
    clauses = split_clauses("; ".join(reasons))
    return "; ".join(reversed(dict.fromkeys(reversed(clauses))))


def max_good_stddev(tolerance: Tolerance, settings: VerdictSettings) -> Array:
    """(6,) standard deviations (m, rad) up to which errors of normal distribution are within the tolerance."""
    return np.asarray(tolerance.limits / ndtri((1 + settings.tolerance_confidence) / 2))


def exceeds_tolerance(
    T_root_sensor: Array, covariance: Array, tolerance: Tolerance, settings: VerdictSettings
) -> bool:
    """Whether a pose (4, 4) with a covariance (6, 6) in the root's axes is too uncertain to be good."""
    return bool(np.any(stddev_along_axes(T_root_sensor, covariance) > max_good_stddev(tolerance, settings)))


def find_ambiguous_poses(kinds: Mapping[str, str], pairs: Sequence[PairwiseEstimate]) -> dict[str, float]:
    """Angles (rad) to other poses that fit equally well, by 2-D scanner without a unique pose."""
    angles = {
        name: [p.alternative_pose_angle for p in pairs if _is_pair_with_plane(p, name, kinds)]
        for name, kind in kinds.items()
        if KINDS[kind].detects == "line"
    }
    return {name: min(found) for name, found in angles.items() if found and min(found) > 0}


def _is_pair_with_plane(pair: PairwiseEstimate, name: str, kinds: Mapping[str, str]) -> bool:
    """Whether the pair is of the sensor and of one that detects the board as a plane."""
    ends = {pair.sensor_a, pair.sensor_b}
    return name in ends and all(KINDS[kinds[other]].detects != "line" for other in ends - {name})


def find_inconsistent_sensors(
    root: str, kinds: Mapping[str, str], pairs: Sequence[PairwiseEstimate], max_normalized_rms: float
) -> dict[str, str]:
    """Sensors whose residuals exceed the expected noise in all of their pairs, and the reason in words.

    A wrong focal length or a wrong size of the print scales all detections of a camera. These are consistent with
    each other, so that neither outlier rejection nor the covariance shows the error.

    Args:
        root: the root sensor; if it is inconsistent, all sensors are.
        kinds: kind by connected sensor.
        pairs: the estimates between them, at the joint solution.
        max_normalized_rms: limit of the RMS residual, relative to the expected noise.

    Returns:
        By sensor; no entry for one that is consistent with another sensor.
    """
    least_rms = {
        name: min((pair.normalized_rms for pair in pairs if name in (pair.sensor_a, pair.sensor_b)), default=1.0)
        for name in kinds
    }
    reasons = {
        name: f"{name} residuals against all other sensors are {ratio:.0f} times the expected noise: "
        f"check {KINDS[kinds[name]].error_causes}"
        for name, ratio in least_rms.items()
        if ratio > max_normalized_rms
    }
    if root in reasons:
        return {name: reasons.get(name, reasons[root]) for name in kinds if name != root}
    return reasons


def merge_reasons(*reasons_by_sensor: Mapping[str, str | Sequence[str]]) -> dict[str, list[str]]:
    """The reasons of each sensor, in order and each once."""
    merged: dict[str, dict[str, None]] = {}
    for reasons in reasons_by_sensor:
        for name, given in reasons.items():
            merged.setdefault(name, {}).update(dict.fromkeys([given] if isinstance(given, str) else given))
    return {name: list(of_sensor) for name, of_sensor in merged.items()}


def collect_findings(findings: Sequence[Finding]) -> dict[str, list[str]]:
    """By sensor that findings make weak, what they are."""
    found: dict[str, list[str]] = {}
    for finding in findings:
        for name in finding.sensors:
            found.setdefault(name, []).append(finding.text)
    return found


def format_axis_error(error: float, axis: int) -> str:
    """An error along (mm) or about (degrees) one of six axes, with three digits."""
    return f"{error * 1000:.3g} mm" if axis < 3 else f"{np.degrees(error):.3g}°"


def _join_axes(axes: list[str], name: str) -> str:
    if len(axes) == 1:
        return f"{axes[0]} of {name} is"
    return f"{', '.join(axes[:-1])} and {axes[-1]} of {name} are"
