"""What a calibration found: poses with covariances, and the evidence for and against each of them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from calgraph.errors import CalibrationError
from calgraph.geometry import Array, se3
from calgraph.result.board_views import BoardOutline, BoardView
from calgraph.result.estimated_parameter import EstimatedParameter
from calgraph.result.snapshots import Snapshot
from calgraph.result.transform_tree import TransformTree

Grade = Literal["good", "weak", "unobservable"]

_UNINFORMATIVE_STDDEV: Mapping[Literal["m", "rad"], float] = {"m": 0.2, "rad": np.radians(10)}
"""Standard deviations beyond which there is no saying where along an axis a sensor is."""


@dataclass(frozen=True)
class Verdict:
    """How far a sensor's pose can be relied on."""

    grade: Grade
    reason: str = ""
    """Which directions are weak, in words, and what would fix them; of a good pose, where it is from if not from
    this recording."""


@dataclass(frozen=True, eq=False)
class SensorPose:
    """Where one sensor is."""

    name: str
    parent: str | None
    """The sensor it hangs from in the spanning tree; None for the root."""
    frame_id: str
    kind: Literal["camera", "lidar2d", "lidar3d"]
    T_root_sensor: Array
    """(4, 4)."""
    covariance: Array
    """(6, 6) of the error in the root's fixed axes, (translation, rotation), m and rad; zero for the root."""
    verdict: Verdict
    clock_offset: float | None = None
    """Sensor clock minus root clock, s; None where it was not estimated."""
    clock_offset_stddev: float | None = None


@dataclass(frozen=True, eq=False)
class Edge:
    """The evidence between two sensors."""

    sensor_a: str
    sensor_b: str
    captures: int
    """How many captures both sensors found the board in; in a network, how many positions of walkers, ten a
    second, both should have seen."""
    inliers: int
    """How many of them the pairwise consensus kept; 0 if the pair could not be calibrated."""
    in_tree: bool
    """Whether the start values of the joint solution came along this edge."""
    residuals: Array
    """(inliers,) distances between the two detections under the final poses, m; in a network the one between the
    pair's own pose and the final one. Empty in a result read back."""
    note: str = ""
    """Why the pair was not used, where it was not."""
    residual_rms: float | None = None
    """Root mean square of ``residuals``, m, taken from them if left out; None where there are none."""

    def __post_init__(self) -> None:
        if self.residual_rms is None:
            object.__setattr__(self, "residual_rms", rms(self.residuals))


@dataclass(frozen=True)
class CaptureRow:
    """What became of one sensor in one capture, or of one walk that a scanner saw: a row of captures.csv."""

    capture: int
    """Its number; a walk's is of one scanner alone."""
    start: float
    """s from the start of the recording."""
    end: float
    sensor: str
    used: bool
    reason: str
    """Why not, where it was not used."""
    residual: float | None = None
    """Distance to what the other sensors saw, m, where it was used."""


@dataclass(frozen=True)
class HeldOutError:
    """How far what a sensor saw is from what the others predict, in captures left out of the solution."""

    views: int
    """How many captures were predicted for it."""
    unit: Literal["px", "m"]
    """Of ``rms`` and ``median``: distances between corners, or of beam ends from the board's plane."""
    rms: float
    median: float
    ratio: float
    """Errors over what noise and the poses' covariances let expect: about 1 if those hold."""
    along: float | None = None
    """RMS along the beam, m; None for cameras."""
    tilt: float | None = None
    """RMS angle between the board's normal as predicted and as seen, rad; None where no view knows it."""

    @property
    def formatted(self) -> tuple[str, str, str, str]:
        """RMS, median, RMS along the beam and tilt as a person reads them; empty where there is none."""
        size = "{:.2f} px".format if self.unit == "px" else _format_millimetres
        along = "" if self.along is None else _format_millimetres(self.along)
        tilt = "" if self.tilt is None else f"{np.degrees(self.tilt):.2f}°"
        return size(self.rms), size(self.median), along, tilt


@dataclass(frozen=True, eq=False)
class Suggestion:
    """A further capture that would make the least certain sensor more certain."""

    hold: str
    """Where and how to hold the board, in words."""
    sensor: str
    """The sensor that is least certain before it."""
    axis: str
    """Along or about which of its axes."""
    unit: Literal["m", "rad"]
    stddev: float
    """Standard deviation along that axis without the capture, but with those suggested before."""
    expected: float
    """And with it."""
    T_root_board: Array
    """(4, 4)."""

    def __str__(self) -> str:
        """The suggestion as a sentence."""
        if self.expected > _UNINFORMATIVE_STDDEV[self.unit]:
            return f"{self.hold}: a step towards {self.axis} of {self.sensor}, which takes more than one"
        before, after = (_format_stddev(value, self.unit) for value in (self.stddev, self.expected))
        return f"{self.hold}: {self.axis} of {self.sensor} {before} → {after}"


@dataclass(frozen=True, eq=False)
class FloorView:
    """What one scanner of a network saw, for pictures."""

    sensor: str
    background: Array
    """(M, 2) what stood still, thinned, root frame, m."""
    tracks: tuple[Array, ...]
    """(N, 2) each, where somebody walked, root frame, m."""
    times: tuple[Array, ...] = ()
    """(N,) each, when they were there by the root's clock, s from the start of the recording."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A tree of sensor poses rooted at one sensor."""

    root: str
    sensors: tuple[SensorPose, ...]
    """The root first; unconnected sensors are not in it."""
    edges: tuple[Edge, ...] = ()
    captures: tuple[CaptureRow, ...] = ()
    unconnected: Mapping[str, str] = field(default_factory=dict)
    """Sensors that nothing connects to the root, each with the reason in words."""
    residuals: Mapping[str, Array] = field(default_factory=dict)
    """Whitened residuals of the joint solution by kind of edge, for histograms and their RMS."""
    outlines: tuple[BoardOutline, ...] = ()
    estimator: str = "hypergraph"
    residual_rms: Mapping[str, float] = field(default_factory=dict)
    """Root mean square of ``residuals`` by kind, taken from them if left out."""
    floor: tuple[FloorView, ...] = ()
    """What the connected scanners of a network saw; empty in a result read back."""
    joint_covariance: Array | None = None
    """(S·6, S·6) of the errors of all ``sensors``, in their order and in the root's fixed axes, correlations
    included; zero for the root. None where it is not known."""
    cross_validation: Mapping[str, HeldOutError] = field(default_factory=dict)
    """Cross-validation by sensor; none for those that no other sensor predicts, and where it was not asked for."""
    suggestions: tuple[Suggestion, ...] = ()
    """Further captures that would help most, the first one first."""
    remarks: tuple[str, ...] = ()
    """What else is to be known of the whole result: what was seen and yet not used, and why."""
    estimated_parameters: tuple[EstimatedParameter, ...] = ()
    """What was estimated besides poses."""
    board_views: tuple[BoardView, ...] = ()
    """What every sensor saw of the board, thinned; empty in a result read back."""
    start: Mapping[str, Array] = field(default_factory=dict)
    """(4, 4) ``T_root_sensor`` where the joint solution of a network started; empty in a result read back."""
    snapshots: tuple[Snapshot, ...] = ()
    """What captures looked like; empty in a result read back."""

    def __post_init__(self) -> None:
        if not self.residual_rms:
            by_kind = {kind: rms(values) for kind, values in self.residuals.items()}
            known = {kind: value for kind, value in by_kind.items() if value is not None}
            object.__setattr__(self, "residual_rms", known)

    def __getitem__(self, name: str) -> SensorPose:
        """The pose of the sensor called ``name``.

        Raises:
            InputError: there is no such sensor; the message names those there are.
            CalibrationError: the sensor is not connected to the root; the message says why.

        """
        self.tree.check_connected(name)
        return next(sensor for sensor in self.sensors if sensor.name == name)

    @property
    def planar(self) -> bool:
        """Whether all poses lie in one plane, which is taken for exact, as those of a network do."""
        others = [sensor for sensor in self.sensors if sensor.parent is not None]
        upright = [np.allclose(s.T_root_sensor[2], [0, 0, 1, 0], rtol=0, atol=1e-12) for s in others]
        return bool(others) and all(upright) and not any(s.covariance[2:5].any() for s in others)

    @property
    def tree(self) -> TransformTree:
        """The poses as a tree that answers any pair of sensors."""
        poses = {sensor.name: sensor.T_root_sensor for sensor in self.sensors}
        return TransformTree(self.root, poses, dict(self.unconnected))

    def transform(self, a: str, b: str) -> Array:
        """``T_a_b`` (4, 4) of any two sensors; raises as :meth:`TransformTree.transform` does."""
        return self.tree.transform(a, b)

    def covariance(self, a: str, b: str) -> Array:
        """Covariance (6, 6) of the error of ``T_a_b`` in the fixed axes of a, (translation, rotation), m and rad.

        Raises:
            InputError: there is no sensor a or b.
            CalibrationError: a or b is not connected to the root, or no joint covariance is known.

        """
        T_root_a, T_root_b = self[a].T_root_sensor, self[b].T_root_sensor
        if self.joint_covariance is None:
            raise CalibrationError(
                f"how errors of {a!r} and {b!r} go together is not known: this result has no joint_covariance"
            )
        names = [sensor.name for sensor in self.sensors]
        both = np.concatenate([6 * names.index(name) + np.arange(6) for name in (a, b)])
        return se3.relative_covariance(T_root_a, T_root_b, self.joint_covariance[np.ix_(both, both)])


def _format_millimetres(metres: float) -> str:
    return f"{1000 * metres:.1f} mm"


def _format_stddev(stddev: float, unit: Literal["m", "rad"]) -> str:
    if stddev > _UNINFORMATIVE_STDDEV[unit]:
        return "unknown"
    return f"±{1000 * stddev:.2g} mm" if unit == "m" else f"±{np.degrees(stddev):.2g}°"


def rms(values: Array) -> float | None:
    """Root mean square of the finite values; None where there are none."""
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else None
