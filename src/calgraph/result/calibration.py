"""What a calibration found: poses with covariances, and the evidence for and against each of them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from calgraph.geometry import Array

Grade = Literal["good", "weak", "unobservable"]


@dataclass(frozen=True)
class Verdict:
    """How far a sensor's pose can be relied on."""

    grade: Grade
    reason: str = ""
    """Which directions are weak, in words, and what would fix them; empty for a good pose."""


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
    """How many captures both sensors found the board in."""
    inliers: int
    """How many of them the pairwise consensus kept; 0 if the pair could not be calibrated."""
    in_tree: bool
    """Whether the start values of the joint solution came along this edge."""
    residuals: Array
    """(inliers,) distances between the two detections under the final poses, m."""
    note: str = ""
    """Why the pair was not used, where it was not."""


@dataclass(frozen=True)
class CaptureRow:
    """What became of one sensor in one capture: a row of captures.csv."""

    capture: int
    start: float
    """s from the start of the recording."""
    end: float
    sensor: str
    used: bool
    reason: str
    """Why not, where it was not used."""
    residual: float | None = None
    """Distance to what the other sensors saw, m, where it was used."""


@dataclass(frozen=True, eq=False)
class BoardOutline:
    """Where the board was in one capture, for pictures."""

    capture: int
    corners: Array
    """(4, 3) corners of the sheet or of the patch seen, root frame, m."""


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

    def __getitem__(self, name: str) -> SensorPose:
        """The pose of the sensor called ``name``; KeyError names the sensors there are."""
        for sensor in self.sensors:
            if sensor.name == name:
                return sensor
        raise KeyError(f"no sensor {name!r} in this calibration; it has {', '.join(s.name for s in self.sensors)}")
