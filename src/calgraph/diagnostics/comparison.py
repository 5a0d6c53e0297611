"""How far given poses are from those that a recording gives, by sensor and axis, in numbers and in words."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import lsq_linear
from scipy.special import chdtri, ndtri

from calgraph.diagnostics.verdict import axis_names
from calgraph.geometry import Array, se3
from calgraph.result import Calibration, ExtrinsicsFile

Outcome = Literal["pass", "warn", "fail"]
_SEVERITY: Sequence[Outcome] = ("pass", "warn", "fail")

# Chance of calling a sensor that is where it should be significantly off.
CHANCE = 1e-3
_LIMIT, _WIDTH = float(chdtri(6, CHANCE)), float(-ndtri(CHANCE / 2))
# Nobody states poses more precisely than this, m and rad.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Tolerance:
    """What may be off without harm."""

    position: float = 0.01
    """m."""
    rotation: float = float(np.radians(0.3))
    """rad."""


@dataclass(frozen=True)
class AxisComparison:
    """A sensor's pose along, or about, one of its own axes."""

    axis: str
    offset: float
    """Given minus found, m or rad."""
    stddev: float
    """Of what was found, and of what is given where that is known, m or rad."""
    outcome: Outcome


@dataclass(frozen=True)
class ResidualComparison:
    """How far a sensor's measurements are from the boards, under two sets of extrinsics."""

    unit: Literal["px", "m"]
    given: float
    """Root mean square, corners in x and y, ranges along the beam; infinite where boards cannot even be placed."""
    found: float


@dataclass(frozen=True)
class SensorComparison:
    """What a recording says of one sensor's given pose."""

    sensor: str
    outcome: Outcome
    reason: str
    """What is wrong, or cannot be told; empty for a pass."""
    distance: float
    """Mahalanobis distance of the given pose from the one found; NaN where there is none."""
    axes: tuple[AxisComparison, ...] = ()
    """x, y, z, and rotations about them; empty where poses cannot be compared."""
    misfit: ResidualComparison | None = None


@dataclass(frozen=True)
class ExtrinsicsComparison:
    """What a recording says of given extrinsics."""

    reference: str
    """The sensor whose frame the others are compared in: the root, or one from which fewer seem to have moved."""
    sensors: tuple[SensorComparison, ...]
    """All but the reference."""
    misfit: ResidualComparison | None
    """Of the reference."""

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
    """Given extrinsics beside those that a recording gives."""

    found: Calibration
    given: ExtrinsicsFile
    frames: Mapping[str, str]
    """By sensor that the file knows, its frame there; the root is among them."""
    tolerance: Tolerance

    @property
    def T_root_sensor(self) -> dict[str, Array]:
        """(4, 4) by sensor, as given."""
        return {name: self.given.transform(self.frames[self.found.root], own) for name, own in self.frames.items()}

    def compare_in_frame(self, reference: str, misfits: Mapping[str, ResidualComparison]) -> ExtrinsicsComparison:
        """The given poses of all sensors in the frame of one, against those found there."""
        sensors = []
        for sensor in self.found.sensors:
            if sensor.name == reference:
                continue
            if sensor.name not in self.frames:
                reason = f"{self.given.path} has neither a frame {sensor.frame_id} nor one called {sensor.name}"
                sensors.append(SensorComparison(sensor.name, "warn", reason, float("nan")))
                continue
            own = self._compare_sensor(reference, sensor.name)
            if sensor.verdict.grade != "good" and own.outcome != "fail":
                parts = [part for part in (own.reason, sensor.verdict.reason) if part]
                own = replace(own, outcome="warn", reason="; ".join(parts))
            sensors.append(replace(own, misfit=misfits.get(sensor.name)))
        alone = [
            SensorComparison(name, "warn", why, float("nan"))
            for name, why in self.found.evidence.unconnected.items()
        ]
        return ExtrinsicsComparison(reference, (*sensors, *alone), misfits.get(reference))

    def _compare_sensor(self, reference: str, name: str) -> SensorComparison:
        """One sensor's given pose against the one found, in its own axes as found."""
        found, of_both = self.found, (self.frames[reference], self.frames[name])
        T_given, T_found = self.given.transform(*of_both), found.transform(reference, name)
        to_own = np.kron(np.eye(2), T_found[:3, :3].T)
        offset = to_own @ se3.difference(T_given, T_found)
        spread = found.covariance(reference, name) + self.given.covariance(*of_both)
        covariance = to_own @ spread @ to_own.T + _ROUNDING**2 * np.eye(6)
        allowed = np.repeat([self.tolerance.position, self.tolerance.rotation], 3)
        outcomes = _grade_axes(offset, covariance, allowed)
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        distance = float(np.linalg.norm(whiten @ offset))
        axes = tuple(
            AxisComparison(axis, float(x), float(s), outcome)
            for axis, x, s, outcome in zip(
                axis_names(found[name].kind), offset, np.sqrt(np.diag(covariance)), outcomes, strict=True
            )
        )
        outcome = _worst_outcome([*outcomes, "warn" if distance**2 > _LIMIT else "pass"])
        return SensorComparison(name, outcome, _explain_axes(axes, allowed, distance), distance, axes)


def match_poses(found: Calibration, given: ExtrinsicsFile, tolerance: Tolerance | None) -> MatchedPoses:
    """Looks up in given extrinsics what a recording has found.

    Raises:
        InputError: the root or all other sensors are not in the file.
    """
    frame_ids = {sensor.name: sensor.frame_id for sensor in found.sensors}
    given.frame_of_sensor(found.root, frame_ids)
    return MatchedPoses(found, given, given.frames_of_sensors(frame_ids), tolerance or Tolerance())


def _grade_axes(offset: Array, covariance: Array, allowed: Array) -> list[Outcome]:
    """What is to be said of each axis."""
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    width = _WIDTH * np.sqrt(np.diag(covariance))
    far, beyond = np.abs(offset) > width, np.abs(offset) > allowed
    significant = float(np.sum((whiten @ offset) ** 2)) > _LIMIT
    failed = significant & far & beyond
    # Axes may be uncertain each, and sure together: then no pose within the tolerance may be likely.
    nearest = lsq_linear(whiten, whiten @ offset, (-allowed, allowed))
    if not failed.any() and 2 * nearest.cost > _LIMIT:
        failed = beyond
    doubtful = (significant & far) | (width > allowed)
    return ["fail" if bad else "warn" if doubt else "pass" for bad, doubt in zip(failed, doubtful, strict=True)]


def _explain_axes(axes: Sequence[AxisComparison], allowed: Array, distance: float) -> str:
    """What is to be said of the axes that do not pass."""
    parts = []
    for i, (axis, limit) in enumerate(zip(axes, allowed, strict=True)):
        off = (
            f"{axis.axis} {format_displacement(axis.offset, i, sign=True)} ±{format_displacement(axis.stddev, i)}"
        )
        if axis.outcome == "fail":
            parts.append(f"{off}, beyond {format_displacement(limit, i)}")
        elif axis.outcome == "warn" and _WIDTH * axis.stddev > limit:
            parts.append(f"{axis.axis} cannot be told: ±{format_displacement(axis.stddev, i)}")
        elif axis.outcome == "warn":
            parts.append(f"{off}: significant, but within {format_displacement(limit, i)}")
    if not parts and distance**2 > _LIMIT:
        parts.append(f"{distance:.1f} standard deviations off in all axes together, but within the tolerance")
    return "; ".join(parts)


def format_displacement(value: float, axis: int, *, sign: bool = False) -> str:
    """A displacement along (mm) or about (degrees) one of six axes, in words."""
    shown, unit, digits = (1000 * value, " mm", 1) if axis < 3 else (float(np.degrees(value)), "°", 2)
    return f"{shown:{'+' if sign else ''}.{digits}f}{unit}"


def _worst_outcome(outcomes: Sequence[Outcome]) -> Outcome:
    return max(outcomes, key=_SEVERITY.index, default="pass")
