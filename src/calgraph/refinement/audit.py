"""Whether given extrinsics agree with what a recording says of them, by sensor and axis."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import lsq_linear
from scipy.special import chdtri, ndtri

from calgraph.errors import CalibrationError
from calgraph.geometry import Array, se3
from calgraph.refinement.bundle import Bundle, State, solve
from calgraph.refinement.joint import Adjusted
from calgraph.refinement.observability import axis_names
from calgraph.refinement.views import Beams, Corners, relative
from calgraph.result import Calibration, KnownPoses

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
class AxisAudit:
    """A sensor's pose along, or about, one of its own axes."""

    axis: str
    offset: float
    """Given minus found, m or rad."""
    stddev: float
    """Of what was found, and of what is given where that is known, m or rad."""
    outcome: Outcome


@dataclass(frozen=True)
class Misfit:
    """How far a sensor's measurements are from the boards, under two sets of extrinsics."""

    unit: Literal["px", "m"]
    given: float
    """Root mean square, corners in x and y, ranges along the beam; infinite where boards cannot even be placed."""
    found: float


@dataclass(frozen=True)
class SensorAudit:
    """What a recording says of one sensor's given pose."""

    sensor: str
    outcome: Outcome
    reason: str
    """What is wrong, or cannot be told; empty for a pass."""
    distance: float
    """Mahalanobis distance of the given pose from the one found; NaN where there is none."""
    axes: tuple[AxisAudit, ...] = ()
    """x, y, z, and rotations about them; empty where poses cannot be compared."""
    misfit: Misfit | None = None


@dataclass(frozen=True)
class Audit:
    """What a recording says of given extrinsics."""

    reference: str
    """The sensor whose frame the others are compared in: the root, or one from which fewer seem to have moved."""
    sensors: tuple[SensorAudit, ...]
    """All but the reference."""
    misfit: Misfit | None
    """Of the reference."""

    @property
    def outcome(self) -> Outcome:
        """The worst of all sensors."""
        return _worst([sensor.outcome for sensor in self.sensors])

    @property
    def failed(self) -> tuple[str, ...]:
        """Sensors that fail."""
        return tuple(sensor.sensor for sensor in self.sensors if sensor.outcome == "fail")


def audit(
    found: Calibration, adjusted: Adjusted | None, given: KnownPoses, tolerance: Tolerance | None = None
) -> Audit:
    """Compares given extrinsics with those found.

    A sensor fails along an axis if it is off by more than the tolerance, and by more than chance explains (1 in
    1000, tested over all six axes and along the one). What is significant but within the tolerance is a warning,
    and so is what the recording is too weak to tell. Where more than one sensor fails in the root's frame, the
    frame in which the fewest do is taken: if the root has moved, all others seem to.

    Args:
        found: the calibration that the recording gives.
        adjusted: its solution, for the residuals; None where there is none.
        given: the extrinsics to be judged.
        tolerance: what may be off without harm.

    Raises:
        InputError: the root or all other sensors are not in the file, or nothing fixed connects them there.
    """
    tolerance = tolerance or Tolerance()
    frame_ids = {sensor.name: sensor.frame_id for sensor in found.sensors}
    given.frame(found.root, frame_ids)
    frames = given.frames_of(frame_ids)
    misfits = _misfits(adjusted, _poses(given, frames, found.root)) if adjusted else {}
    audits = [seen_from(reference, found, given, frames, tolerance, misfits) for reference in frames]
    from_root = next(a for a in audits if a.reference == found.root)
    # One sensor that moved in the frame of another: either did. The root is where people look from.
    best = min(audits, key=lambda a: len(a.failed)) if len(from_root.failed) > 1 else from_root
    return best if len(best.failed) < len(from_root.failed) else from_root


def seen_from(
    reference: str,
    found: Calibration,
    given: KnownPoses,
    frames: Mapping[str, str],
    tolerance: Tolerance,
    misfits: Mapping[str, Misfit],
) -> Audit:
    """The given poses of all sensors in the frame of one, against those found there."""
    sensors = []
    for sensor in found.sensors:
        if sensor.name == reference:
            continue
        if sensor.name not in frames:
            reason = f"{given.path} has neither a frame {sensor.frame_id} nor one called {sensor.name}"
            sensors.append(SensorAudit(sensor.name, "warn", reason, float("nan")))
            continue
        own = _judged(reference, sensor.name, found, given, frames, tolerance)
        if sensor.verdict.grade != "good" and own.outcome != "fail":
            parts = [part for part in (own.reason, sensor.verdict.reason) if part]
            own = replace(own, outcome="warn", reason="; ".join(parts))
        sensors.append(replace(own, misfit=misfits.get(sensor.name)))
    alone = [SensorAudit(name, "warn", why, float("nan")) for name, why in found.unconnected.items()]
    return Audit(reference, (*sensors, *alone), misfits.get(reference))


def _judged(
    reference: str,
    name: str,
    found: Calibration,
    given: KnownPoses,
    frames: Mapping[str, str],
    tolerance: Tolerance,
) -> SensorAudit:
    """One sensor's given pose against the one found, in its own axes as found."""
    T_given, T_found = given.transform(frames[reference], frames[name]), found.transform(reference, name)
    to_own = np.kron(np.eye(2), T_found[:3, :3].T)
    offset = to_own @ se3.difference(T_given, T_found)
    spread = found.covariance(reference, name) + given.covariance(frames[reference], frames[name])
    covariance = to_own @ spread @ to_own.T + _ROUNDING**2 * np.eye(6)
    allowed = np.repeat([tolerance.position, tolerance.rotation], 3)
    outcomes = _outcomes(offset, covariance, allowed)
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    distance = float(np.linalg.norm(whiten @ offset))
    axes = tuple(
        AxisAudit(axis, float(x), float(s), outcome)
        for axis, x, s, outcome in zip(
            axis_names(found[name].kind), offset, np.sqrt(np.diag(covariance)), outcomes, strict=True
        )
    )
    outcome = _worst([*outcomes, "warn" if distance**2 > _LIMIT else "pass"])
    return SensorAudit(name, outcome, _reason(axes, allowed, distance), distance, axes)


def _outcomes(offset: Array, covariance: Array, allowed: Array) -> list[Outcome]:
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


def _reason(axes: Sequence[AxisAudit], allowed: Array, distance: float) -> str:
    """What is to be said of the axes that do not pass."""
    parts = []
    for i, (axis, limit) in enumerate(zip(axes, allowed, strict=True)):
        off = f"{axis.axis} {size(axis.offset, i, sign=True)} ±{size(axis.stddev, i)}"
        if axis.outcome == "fail":
            parts.append(f"{off}, beyond {size(limit, i)}")
        elif axis.outcome == "warn" and _WIDTH * axis.stddev > limit:
            parts.append(f"{axis.axis} cannot be told: ±{size(axis.stddev, i)}")
        elif axis.outcome == "warn":
            parts.append(f"{off}: significant, but within {size(limit, i)}")
    if not parts and distance**2 > _LIMIT:
        parts.append(f"{distance:.1f} standard deviations off in all axes together, but within the tolerance")
    return "; ".join(parts)


def size(value: float, axis: int, *, sign: bool = False) -> str:
    """A displacement along (mm) or about (degrees) one of six axes, in words."""
    shown, unit, digits = (1000 * value, " mm", 1) if axis < 3 else (float(np.degrees(value)), "°", 2)
    return f"{shown:{'+' if sign else ''}.{digits}f}{unit}"


def _poses(given: KnownPoses, frames: Mapping[str, str], root: str) -> dict[str, Array]:
    """``T_root_sensor`` (4, 4) as given."""
    return {name: given.transform(frames[root], frame) for name, frame in frames.items()}


def _misfits(adjusted: Adjusted, T_root_sensor: Mapping[str, Array]) -> dict[str, Misfit]:
    """By sensor, its residuals under given poses and under those found, boards placed anew for both."""
    bundle, state = adjusted.bundle, adjusted.solved.state
    views = tuple(
        own.where(np.full(len(own.board), name in T_root_sensor))
        for name, own in zip(bundle.names, bundle.views, strict=True)
    )
    held = replace(bundle, views=views, body=np.zeros(len(views), dtype=np.intp), priors=())
    poses = [T_root_sensor.get(n, T) for n, T in zip(bundle.names, state.T_root_sensor, strict=True)]
    given = _residuals(held, replace(state, T_root_sensor=np.array(poses)))
    found = _residuals(held, state)
    return {
        name: Misfit("px" if isinstance(own, Corners) else "m", given[s], found[s])
        for s, (name, own) in enumerate(zip(bundle.names, views, strict=True))
        if len(own.board)
    }


def _residuals(held: Bundle, state: State) -> list[float]:
    """By sensor, the root mean square of what separates its measurements from the boards, px or m."""
    try:
        placed = solve(held, state).state
    except CalibrationError:
        # So far off that boards are behind a camera.
        return [float("inf")] * len(held.views)
    sizes = []
    for s, views in enumerate(held.views):
        T_sensor_board = relative(placed.T_root_sensor[s], placed.T_root_board[views.board])
        residual = views.linearize(T_sensor_board, placed.own[held.own(s)]).residual
        if isinstance(views, Beams):
            residual = residual * views.sigma[:, None]
        elif isinstance(views, Corners):
            residual = residual * views.scale * views.noise.pixel
        sizes.append(float(np.sqrt(np.mean(residual**2))) if residual.size else 0.0)
    return sizes


def _worst(outcomes: Sequence[Outcome]) -> Outcome:
    return max(outcomes, key=_SEVERITY.index, default="pass")
