"""The evidence for and against a calibration: pairs, captures, residuals, cross-validation, suggestions."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from calgraph.config import Tolerance
from calgraph.config.settings import VerdictSettings
from calgraph.geometry import Array
from calgraph.result.file_types import Count, NonNegative

# Files do not keep the limits of verdicts, so that texts use their defaults.
_LIMITS = VerdictSettings()
_UNOBSERVABLE_STDDEV: Mapping[Literal["m", "rad"], float] = {
    "m": _LIMITS.unobservable_translation_stddev,
    "rad": _LIMITS.unobservable_rotation_stddev,
}


@dataclass(frozen=True, eq=False)
class Edge:
    """The shared observations of two sensors."""

    sensor_a: str
    sensor_b: str
    captures: int
    """Number of captures in which both sensors detected the board; in a network, of tracked positions, ten per
    second, that both are expected to detect."""
    inliers: int
    """Number of inliers among them; 0 if the pair has no relative pose."""
    in_tree: bool
    """Whether the edge is in the spanning tree that initialized the joint solution."""
    residuals: Array
    """(inliers,) distances between the two detections under the final poses, m; in a network the distance of the
    pairwise pose from the final one. Empty in a result read back."""
    note: str = ""
    """Why the pair was not used, where it was not."""
    residual_rms: float | None = None
    """Root mean square of ``residuals``, m, taken from them if left out; None where there are none."""

    def __post_init__(self) -> None:
        if self.residual_rms is None:
            object.__setattr__(self, "residual_rms", rms(self.residuals))


@dataclass(frozen=True)
class CaptureRow:
    """The use of one sensor in one capture, or of one track of a scanner: a row of captures.csv."""

    capture: int
    """Its number; that of a track counts within its scanner."""
    start: float
    """s from the start of the recording."""
    end: float
    sensor: str
    used: bool
    reason: str
    """Why not, where it was not used."""
    residual: float | None = None
    """RMS distance to the detections of other sensors, m, where it was used."""


@dataclass(frozen=True)
class FitError:
    """Residuals of the measurements of a sensor that the joint solution used."""

    count: int
    """Number of printed corners, or of beams."""
    unit: Literal["px", "m"]
    """Of ``rms``: reprojection errors of corners, or distances of beam ends from the board's plane; in a network
    errors of ranges."""
    rms: float

    @property
    def formatted(self) -> str:
        """The RMS with its unit."""
        return format_error(self.rms, self.unit)


@dataclass(frozen=True)
class HeldOutError:
    """Cross-validation of a sensor: errors of its measurements on held-out captures, predicted from the others."""

    captures: Count
    """Number of predicted captures, each counted once with however many boards."""
    unit: Literal["px", "m"]
    """Of ``rms`` and ``median``: distances between corners, or of beam ends from the board's plane."""
    rms: NonNegative
    median: NonNegative
    ratio: NonNegative
    """Observed over expected error, given noise and covariances of poses: about 1 if these are consistent."""
    along: NonNegative | None = None
    """RMS along the beam, m; None for cameras."""
    tilt: NonNegative | None = None
    """RMS angle between predicted and measured normal of the board, rad; None where no view determines it."""

    @property
    def formatted(self) -> tuple[str, str, str, str]:
        """RMS, median, RMS along the beam and tilt as text; empty where there is none."""
        along = "" if self.along is None else format_error(self.along, "m")
        tilt = "" if self.tilt is None else f"{np.degrees(self.tilt):.2f}°"
        return format_error(self.rms, self.unit), format_error(self.median, self.unit), along, tilt


@dataclass(frozen=True, eq=False)
class Suggestion:
    """A further capture that would reduce the uncertainty of the least certain sensor."""

    hold: str
    """Where and how to hold the board, in words."""
    sensor: str
    """The sensor that is least certain before it."""
    axis: str
    """Its least certain axis."""
    unit: Literal["m", "rad"]
    stddev: float
    """Standard deviation along that axis without the capture, but with those suggested before."""
    expected: float
    """And with it."""
    T_root_board: Array
    """(4, 4)."""

    def __str__(self) -> str:
        """The suggestion as a sentence."""
        if self.expected > _UNOBSERVABLE_STDDEV[self.unit]:
            return f"{self.hold}: the first of several captures that {self.axis} of {self.sensor} needs"
        before, after = (_format_stddev(value, self.unit) for value in (self.stddev, self.expected))
        return f"{self.hold}: σ of {self.axis} of {self.sensor} {before} → {after}"


@dataclass(frozen=True, eq=False)
class Remedy:
    """What would make a sensor more certain than it is."""

    action: str
    """What to do, in words."""
    sensor: str
    axis: str
    """Its least certain axis now, relative to the tolerance; another one, where only that remains uncertain."""
    unit: Literal["m", "rad"]
    stddev: float
    """Standard deviation along that axis now,"""
    expected: float
    """and after the remedy."""
    suffices: bool
    """Whether all axes of the sensor are then certain enough for the tolerance."""
    captures: int = 0
    """Further captures that are a part of it."""
    uncertainty: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """By sensor or board, what to state in rig.yaml as ``uncertainty`` afterwards, in its units."""
    T_root_board: Array | None = None
    """(4, 4) of a board to record, where that is the remedy."""
    duration: float = 0.0
    """Of a further recording of a network that is a part of it, s."""

    def __str__(self) -> str:
        """The remedy as a sentence."""
        return f"{self.action}{self.statement}: {self.effect}"

    @property
    def effect(self) -> str:
        """What it does to the sensor, as a clause."""
        before, after = (_format_stddev(value, self.unit) for value in (self.stddev, self.expected))
        enough = "" if self.suffices else ", not enough alone"
        return f"σ of {self.axis} of {self.sensor} {before} → {after}{enough}"

    @property
    def statement(self) -> str:
        """What to state in rig.yaml afterwards, as the rest of a clause; nothing where captures are the remedy."""
        of_values: dict[str, list[str]] = {}
        for of, known in self.uncertainty.items():
            of_values.setdefault(", ".join(f"{key}: {value:.2g}" for key, value in known.items()), []).append(of)
        stated = ((values, " and ".join(names)) for values, names in of_values.items())
        return "".join(f", and state uncertainty: {{{values}}} of {names}" for values, names in stated)


@dataclass(frozen=True)
class ModelledBodies:
    """What the joint solution of a network takes the moving objects for."""

    shape: Literal["legs", "ellipses", "cylinders"]
    """Single legs, whole people, or cylinders."""
    count: Count
    """Of tracked objects; one that leaves all views and returns counts twice."""

    def __str__(self) -> str:
        """The shape and count in words."""
        return f"{self.shape} ({self.count} tracked)"


@dataclass(frozen=True, eq=False)
class Evidence:
    """What supports a calibration, and what contradicts it."""

    estimator: str = "hypergraph"
    """The joint estimator of the poses."""
    tolerance: Tolerance | None = None
    """With which verdicts were given; None in a result from before it was kept."""
    bodies: ModelledBodies | None = None
    """Of a network's joint solution; None for averages of pairs."""
    edges: tuple[Edge, ...] = ()
    captures: tuple[CaptureRow, ...] = ()
    """Captures of a rig, or tracks of a network, with how each sensor's measurements were used."""
    unconnected: Mapping[str, str] = field(default_factory=dict)
    """Sensors without a path of edges to the root, each with the reason."""
    remarks: tuple[str, ...] = ()
    """Warnings about the whole result, such as observations that were not used, with the reason."""
    residuals: Mapping[str, Array] = field(default_factory=dict)
    """Whitened residuals of the joint solution by sensor or kind of edge; empty in a result read back."""
    residual_rms: Mapping[str, float] = field(default_factory=dict)
    """Root mean square of ``residuals``, computed from them if left out."""
    fit: Mapping[str, FitError] = field(default_factory=dict)
    """Residuals of the joint solution by sensor, in their units; none of estimators without predictions."""
    cross_validation: Mapping[str, HeldOutError] = field(default_factory=dict)
    """Errors on held-out captures by sensor; none for sensors that no other sensor predicts."""
    suggestions: tuple[Suggestion, ...] = ()
    """Further captures that would reduce uncertainty most, best first."""
    remedies: tuple[Remedy, ...] = ()
    """Of sensors that are less certain than the tolerance, the cheapest that suffice first."""
    initial_poses: Mapping[str, Array] = field(default_factory=dict)
    """(4, 4) ``T_root_sensor`` at the start of a network's joint solution; empty in a result read back."""

    @property
    def remedies_by_action(self) -> dict[str, tuple[Remedy, ...]]:
        """The remedies of sensors by what to do, with what to state afterwards."""
        actions = dict.fromkeys(one.action + one.statement for one in self.remedies)
        return {
            action: tuple(one for one in self.remedies if one.action + one.statement == action)
            for action in actions
        }

    @property
    def unconnected_by_reason(self) -> dict[str, tuple[str, ...]]:
        """The names of unconnected sensors that have the same reason."""
        reasons = dict.fromkeys(self.unconnected.values())
        return {why: tuple(name for name, one in self.unconnected.items() if one == why) for why in reasons}

    def __post_init__(self) -> None:
        if not self.residual_rms:
            by_kind = {kind: rms(values) for kind, values in self.residuals.items()}
            finite = {kind: value for kind, value in by_kind.items() if value is not None}
            object.__setattr__(self, "residual_rms", finite)


def format_error(value: float, unit: Literal["px", "m"]) -> str:
    """A reprojection error in pixels, or a length in millimetres."""
    return f"{value:.2f} px" if unit == "px" else f"{1000 * value:.1f} mm"


def _format_stddev(stddev: float, unit: Literal["m", "rad"]) -> str:
    if stddev > _UNOBSERVABLE_STDDEV[unit]:
        return "unknown"
    value, suffix = (1000 * stddev, " mm") if unit == "m" else (float(np.degrees(stddev)), "°")
    return f"{value:.0f}{suffix}" if value >= 100 else f"{value:.2g}{suffix}"


def rms(values: Array) -> float | None:
    """Root mean square of the finite values; None where there are none."""
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else None
