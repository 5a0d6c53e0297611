"""Comparison of given extrinsics with those estimated from a recording, by sensor and axis."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal

import numpy as np
from scipy.optimize import lsq_linear
from scipy.special import chdtri, ndtri

from calgraph.config import Tolerance
from calgraph.config.settings import VerdictSettings
from calgraph.geometry import Array, se3
from calgraph.result import Calibration, ExtrinsicsFile
from calgraph.result.sensor_pose import stddev_along_axes
from calgraph.verdict.grades import axis_names, describe_largest, format_axis_error, max_good_stddev

Outcome = Literal["pass", "warn", "fail"]
_SEVERITY: Sequence[Outcome] = ("pass", "warn", "fail")

# Times as many captures as were used, up to which their number is stated as what would decide. Where more are
# needed, board poses that determine the direction are missing.
_MAX_FACTOR = 10.0

# Standard deviation of the rounding of given poses, m and rad; makes covariances regular.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class SignificanceTest:
    """Limits of a test with a given probability of a false alarm."""

    max_chi2: float
    """Of the squared Mahalanobis distance of a pose."""
    max_sigmas: float
    """Of the error of one axis, in standard deviations."""

    @classmethod
    def of(cls, false_alarm_probability: float, axes: int = 6) -> "SignificanceTest":
        """The limits for a probability of a false alarm, of poses with a number of measured axes."""
        return cls(float(chdtri(axes, false_alarm_probability)), float(-ndtri(false_alarm_probability / 2)))


@dataclass(frozen=True)
class AxisComparison:
    """Comparison along, or about, one axis of a sensor."""

    axis: str
    offset: float
    """Given minus estimated, m or rad."""
    stddev: float
    """Of the estimate, and of the given pose where that has a covariance, m or rad; NaN where it was not measured,
    and is not compared."""
    outcome: Outcome
    max_stddev: float = np.nan
    """Limit of ``stddev`` for a decision, m or rad: that of a good pose with the same tolerance; where the offset
    is beyond the tolerance, that with which it is significant."""
    estimate_stddev: float = np.nan
    """The part of ``stddev`` that is the estimate's, m or rad."""

    @property
    def undecided(self) -> bool:
        """Whether the poses are too uncertain for a pass or a fail."""
        return self.outcome == "warn" and self.stddev > self.max_stddev

    @property
    def of_estimate(self) -> bool:
        """Whether the uncertainty is the estimate's alone; given poses without covariance are rounded."""
        return self.stddev <= float(np.hypot(self.estimate_stddev, 2 * _ROUNDING))

    @property
    def captures_needed(self) -> float:
        """How many times as many captures the axis needs at least; infinite if the given pose is too uncertain."""
        allowed = self.max_stddev**2 - (self.stddev**2 - self.estimate_stddev**2)
        return self.estimate_stddev**2 / allowed if allowed > 0 else np.inf


@dataclass(frozen=True)
class ResidualComparison:
    """RMS residual of a sensor under the given and under the estimated extrinsics."""

    unit: Literal["px", "m"]
    given: float
    """Reprojection errors in x and y, or range errors along the beam; infinite where boards cannot be located."""
    found: float


@dataclass(frozen=True)
class SensorComparison:
    """Comparison of one sensor's given pose with the estimate."""

    sensor: str
    outcome: Outcome
    reason: str
    """What fails, or is too uncertain; empty for a pass."""
    distance: float
    """Mahalanobis distance between given and estimated pose; NaN where poses cannot be compared."""
    axes: tuple[AxisComparison, ...] = ()
    """x, y, z, and rotations about them; empty where poses cannot be compared."""
    misfit: ResidualComparison | None = None


@dataclass(frozen=True)
class ExtrinsicsComparison:
    """Comparison of given extrinsics with the estimates from a recording."""

    reference: str
    """The sensor in whose frame the others are compared: the root, or one in whose frame fewer fail."""
    sensors: tuple[SensorComparison, ...]
    """All but the reference."""
    misfit: ResidualComparison | None
    """Of the reference."""
    remedy: str = ""
    """What would decide the undecided axes; empty where there are none."""

    @property
    def outcome(self) -> Outcome:
        """The worst of all sensors."""
        return _worst_outcome([sensor.outcome for sensor in self.sensors])

    @property
    def failed(self) -> tuple[str, ...]:
        """Sensors that fail."""
        return tuple(sensor.sensor for sensor in self.sensors if sensor.outcome == "fail")


@dataclass(frozen=True, eq=False)
class MatchedPoses:
    """Given extrinsics matched with estimated ones."""

    estimated: Calibration
    given: ExtrinsicsFile
    frames: Mapping[str, str]
    """Frame in the file by sensor, of all sensors that the file contains; the root is among them."""
    tolerance: Tolerance
    settings: VerdictSettings
    data: str = ""
    """What the estimates are from, in the plural; captures or tracks if empty."""

    @property
    def T_root_sensor(self) -> dict[str, Array]:
        """Given poses (4, 4) by sensor."""
        return {
            name: self.given.transform(self.frames[self.estimated.root], frame)
            for name, frame in self.frames.items()
        }

    def compare_in_frame(
        self, reference: str, residuals: Mapping[str, ResidualComparison]
    ) -> ExtrinsicsComparison:
        """Compares the poses of all sensors in the frame of one of them."""
        compared = []
        for sensor in self.estimated.sensors:
            if sensor.name == reference:
                continue
            if sensor.name not in self.frames:
                reason = f"{self.given.path} has neither a frame {sensor.frame_id} nor one called {sensor.name}"
                compared.append(SensorComparison(sensor.name, "warn", reason, float("nan")))
                continue
            comparison = self._compare_sensor(reference, sensor.name)
            if sensor.verdict.grade != "good" and comparison.outcome != "fail":
                parts = [part for part in (comparison.reason, sensor.verdict.reason) if part]
                comparison = replace(comparison, outcome="warn", reason="; ".join(parts))
            compared.append(replace(comparison, misfit=residuals.get(sensor.name)))
        unconnected = [
            SensorComparison(name, "warn", reason, float("nan"))
            for name, reason in self.estimated.evidence.unconnected.items()
        ]
        return ExtrinsicsComparison(
            reference, (*compared, *unconnected), residuals.get(reference), self._find_remedy(reference, compared)
        )

    def _compare_sensor(self, reference: str, name: str) -> SensorComparison:
        """Compares the given pose of one sensor with the estimate, along the axes of the estimated sensor."""
        estimated, frames = self.estimated, (self.frames[reference], self.frames[name])
        T_given, T_estimated = self.given.transform(*frames), estimated.transform(reference, name)
        to_sensor = np.kron(np.eye(2), T_estimated[:3, :3].T)
        offset = to_sensor @ se3.difference(T_given, T_estimated)
        of_estimate = estimated.covariance(reference, name)
        both = of_estimate + self.given.covariance(*frames)
        # Scanners of a network have a common horizontal plane: what is not measured is the same along all axes.
        measured = np.flatnonzero(~np.isnan(np.diag(both)))
        covariance = to_sensor @ np.nan_to_num(both) @ to_sensor.T + _ROUNDING**2 * np.eye(6)
        stddev = np.sqrt(np.diag(covariance))
        estimate_stddev = stddev_along_axes(T_estimated, np.nan_to_num(of_estimate))
        allowed, compared = self.tolerance.limits, np.ix_(measured, measured)
        test = SignificanceTest.of(self.settings.false_alarm_probability, 3 if estimated.planar else 6)
        good = max_good_stddev(self.tolerance, self.settings)
        significant = np.abs(offset) / np.sqrt(test.max_chi2)
        max_stddev = np.where(np.abs(offset) > allowed, np.minimum(significant, good), good)
        graded = _grade_axes(offset[measured], covariance[compared], allowed[measured], max_stddev[measured], test)
        outcomes: dict[int, Outcome] = dict(zip(measured.tolist(), graded, strict=True))
        whiten = np.linalg.inv(np.linalg.cholesky(covariance[compared]))
        distance = float(np.linalg.norm(whiten @ offset[measured]))
        axes = tuple(
            AxisComparison(
                axis,
                float(offset[i]),
                float(stddev[i]),
                outcomes[i],
                float(max_stddev[i]),
                float(estimate_stddev[i]),
            )
            if i in outcomes
            else AxisComparison(axis, float(offset[i]), np.nan, "pass")
            for i, axis in enumerate(axis_names(estimated[name].kind))
        )
        outcome = _worst_outcome([*outcomes.values(), "warn" if distance**2 > test.max_chi2 else "pass"])
        # Of a sensor that is not good, the verdict names the axes that the recording leaves too uncertain.
        named = reference == estimated.root and estimated[name].verdict.grade != "good" and outcome != "fail"
        reason = _explain_axes(axes, allowed, distance, test, named=named)
        return SensorComparison(name, outcome, reason, distance, axes)

    def _find_remedy(self, reference: str, compared: Sequence[SensorComparison]) -> str:
        """What would decide the undecided axes of all sensors: a remedy, more captures, or a larger tolerance.

        The variance of an estimate falls at most in proportion to the captures, so their number is the least one.
        """
        undecided = [
            (sensor.sensor, i, axis) for sensor in compared for i, axis in enumerate(sensor.axes) if axis.undecided
        ]
        if not undecided:
            return ""
        factor, sensor = max((axis.captures_needed, name) for name, _, axis in undecided)
        data = self.data or ("tracks" if self.estimated.planar else "captures")
        used = sum(row.used for row in self.estimated.evidence.captures if row.sensor == sensor)
        known = next((one for one in self.estimated.evidence.remedies if one.sensor == sensor), None)
        if known and reference == self.estimated.root and all(axis.of_estimate for _, _, axis in undecided):
            remedy = str(known)
        elif np.isinf(factor):
            remedy = f"no recording decides {sensor}, as the given pose itself is too uncertain"
        elif factor > _MAX_FACTOR:
            remedy = f"{data} that determine {sensor} in other directions than these"
        elif not used:
            remedy = f"a recording that is at least {np.ceil(10 * factor) / 10:g} times as long"
        else:
            remedy = f"at least {int(np.ceil(factor * used))} {data} of {sensor} like the {used} that were used"
        sources = "".join(f"; {clause}" for clause in self._describe_sources(sensor, undecided))
        limits = self.tolerance.limits
        if _MAX_FACTOR < factor < np.inf or any(abs(axis.offset) > limits[i] for _, i, axis in undecided):
            return remedy + sources
        needed = limits.copy()
        for _, i, axis in undecided:
            needed[i] = max(needed[i], limits[i] * axis.stddev / axis.max_stddev)
        # Rounded up, so that the stated tolerance decides.
        millimetres = np.ceil(1e4 * needed[:3].max()) / 10
        degrees = np.ceil(100 * np.degrees(needed[3:].max())) / 100
        return f"{remedy}, or a tolerance of {millimetres:g} mm and {degrees:g}°{sources}"

    def _describe_sources(self, sensor: str, undecided: Sequence[tuple[str, int, AxisComparison]]) -> list[str]:
        """What the estimate's uncertainty of a sensor comes from, along its least certain axis, as a clause."""
        if self.estimated.budget is None or sensor == self.estimated.root:
            return []
        k = [one.name for one in self.estimated.sensors].index(sensor)
        axis, name = max(
            (axis.stddev / axis.max_stddev, i, axis.axis) for one, i, axis in undecided if one == sensor
        )[1:]
        return describe_largest(self.estimated.budget.shares_by_source(k), axis, f"{name} of {sensor}")


def compare_poses(
    matched: MatchedPoses, residuals: Mapping[str, ResidualComparison] = MappingProxyType({})
) -> ExtrinsicsComparison:
    """Compares given extrinsics with estimated ones, in the frame in which the fewest sensors fail.

    A sensor fails along an axis if its error exceeds the tolerance and is significant, over all six axes and along
    that axis. Significant errors within the tolerance are warnings, and so are axes whose uncertainty exceeds the
    tolerance. If the root has moved, all others appear to have moved.

    Args:
        matched: the extrinsics and the estimate.
        residuals: by sensor, under both.
    """
    comparisons = [matched.compare_in_frame(reference, residuals) for reference in matched.frames]
    in_root = next(c for c in comparisons if c.reference == matched.estimated.root)
    # If one sensor fails, it or the reference has moved: the frame of the root is kept.
    best = min(comparisons, key=lambda c: len(c.failed)) if len(in_root.failed) > 1 else in_root
    return best if len(best.failed) < len(in_root.failed) else in_root


def match_poses(
    estimated: Calibration, given: ExtrinsicsFile, tolerance: Tolerance, settings: VerdictSettings, data: str = ""
) -> MatchedPoses:
    """Matches the sensors of a calibration with the frames of given extrinsics.

    Raises:
        InputError: the root or all other sensors are not in the file.
    """
    frame_ids = {sensor.name: sensor.frame_id for sensor in estimated.sensors}
    given.frame_of_sensor(estimated.root, frame_ids)
    return MatchedPoses(estimated, given, given.frames_of_sensors(frame_ids), tolerance, settings, data)


def _grade_axes(
    offset: Array, covariance: Array, allowed: Array, max_stddev: Array, test: SignificanceTest
) -> list[Outcome]:
    """The outcome of each axis."""
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    stddev = np.sqrt(np.diag(covariance))
    significant_axis, beyond = np.abs(offset) > test.max_sigmas * stddev, np.abs(offset) > allowed
    significant = float(np.sum((whiten @ offset) ** 2)) > test.max_chi2
    failed = significant & significant_axis & beyond
    # Single axes may be uncertain while all poses within the tolerance are improbable.
    nearest = lsq_linear(whiten, whiten @ offset, (-allowed, allowed))
    if not failed.any() and 2 * nearest.cost > test.max_chi2:
        failed = beyond
    warned = (significant & significant_axis) | (stddev > max_stddev)
    return ["fail" if fails else "warn" if warns else "pass" for fails, warns in zip(failed, warned, strict=True)]


def _explain_axes(
    axes: Sequence[AxisComparison], allowed: Array, distance: float, test: SignificanceTest, *, named: bool
) -> str:
    """The reasons of the axes that do not pass; uncertain axes of the estimate may be named already."""
    parts, uncertain = [], []
    for i, (axis, limit) in enumerate(zip(axes, allowed, strict=True)):
        sigma = f"σ {format_displacement(axis.stddev, i)}"
        displacement = f"{axis.axis} {format_displacement(axis.offset, i, sign=True)} ({sigma})"
        if axis.outcome == "fail":
            parts.append(f"{displacement}, beyond {format_displacement(limit, i)}")
        elif axis.undecided and abs(axis.offset) > limit:
            parts.append(f"{displacement}: beyond {format_displacement(limit, i)}, but not significant")
        elif axis.undecided and not (named and axis.estimate_stddev > axis.max_stddev):
            stddev, most = (format_axis_error(s, i) for s in (axis.stddev, axis.max_stddev))
            uncertain.append(f"{axis.axis} σ {stddev} (limit {most})")
        elif axis.outcome == "warn" and not axis.undecided:
            parts.append(f"{displacement}: significant, but within {format_displacement(limit, i)}")
    if uncertain:
        parts.append(f"too uncertain: {', '.join(uncertain)}")
    undecided = [axis for axis in axes if axis.undecided]
    if undecided and all(axis.estimate_stddev <= axis.max_stddev for axis in undecided):
        parts.append("the recording alone is accurate enough, but the given pose is uncertain, too")
    if not parts and distance**2 > test.max_chi2:
        parts.append(f"{distance:.1f} standard deviations off over all axes, but within the tolerance")
    return "; ".join(parts)


def format_displacement(value: float, axis: int, *, sign: bool = False) -> str:
    """A displacement along (mm) or about (degrees) one of six axes."""
    shown, unit, digits = (1000 * value, " mm", 1) if axis < 3 else (float(np.degrees(value)), "°", 2)
    return f"{round(shown, digits) + 0.0:{'+' if sign else ''}.{digits}f}{unit}"


def _worst_outcome(outcomes: Sequence[Outcome]) -> Outcome:
    return max(outcomes, key=_SEVERITY.index, default="pass")
