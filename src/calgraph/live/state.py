"""What the operator's page shows: the state of a session at one moment."""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from calgraph.geometry import Array
from calgraph.live.floor_grid import FloorGrid
from calgraph.live.sensor_solution import SensorSolution

Phase = Literal["connecting", "background", "ready", "waiting", "measuring", "finishing", "finished", "failed"]
"""``background``: the views must stay free of board and operator; ``ready``: for a capture; ``waiting``: a capture
is triggered, and the board still moves; ``measuring``: sensors measure the board at rest; ``finishing``: the
recording is calibrated as a whole; ``failed``: the session ended with an error."""

Action = Literal["trigger", "automatic", "manual", "discard", "finish"]
"""What an operator wants. ``trigger``: take a capture as soon as the board rests, or calibrate what was driven;
``automatic`` and ``manual``:
whether captures are taken without the button; ``discard``: leave out the last capture; ``finish``: end the
recording, and calibrate it."""


@dataclass(frozen=True)
class SensorState:
    """One sensor of a rig or network."""

    name: str
    kind: str
    """camera, lidar2d or lidar3d."""
    rate: float = 0.0
    """Messages per second of late."""
    problem: str = ""
    """What keeps it from working: no message, another type, a wrong clock; empty if nothing does."""
    sees_board: bool | None = None
    """Whether it detects the board now; None if unknown."""
    reason: str = ""
    """Why it does not detect the board: "not in view", "blurred"."""
    moving: bool = False
    """Whether its view changes."""
    captures: int = 0
    """In which it detected the board."""
    coverage: tuple[float, ...] = ()
    """Of a camera: shares (3 x 3, row by row) of image regions with detected boards, 0..1. Of scanners: the same
    over sectors of azimuth from -180 to 180 degrees."""
    stddev_mm: float | None = None
    """Largest standard deviation of the position along an axis, mm; None without a pose, and for the root."""
    stddev_degrees: float | None = None
    progress: float = 0.0
    """Tolerance over uncertainty, limited to 0..1: 1 where the pose is within tolerance with 95 %."""
    grade: str = ""
    """good, weak or unobservable; empty without a pose."""
    clock_ms: float | None = None
    """Its clock minus the root's, ms; None where it is not estimated."""
    picture: int = 0
    """Counts the pictures of its view; 0 before the first."""

    def with_pose(self, solved: SensorSolution | None, root: str) -> "SensorState":
        """The state with what is known of the sensor's pose."""
        if solved is None:
            return self
        known = self.name != root and bool(np.isfinite(solved.stddev).all())
        return replace(
            self,
            stddev_mm=1000 * float(solved.stddev[:3].max()) if known else None,
            stddev_degrees=float(np.degrees(solved.stddev[3:].max())) if known else None,
            progress=solved.progress,
            grade=solved.grade,
            clock_ms=None if solved.clock_offset is None else 1000 * solved.clock_offset,
        )


@dataclass(frozen=True)
class Advice:
    """What to do next."""

    text: str
    """Where and how to hold the board, in words."""
    picture: str = ""
    """An SVG image of it."""
    expected: str = ""
    """What it is expected to improve: "laser_left: 12 to 6 mm"."""


@dataclass(frozen=True)
class Need:
    """Something that a calibration needs of a drive."""

    label: str
    """"Turned left"."""
    text: str
    """How much there is of how much: "40 of 90°"."""
    progress: float
    """The ratio; 1 and more where it suffices."""
    advice: str
    """What to do for more: "turn more to the left"."""
    optional: bool = False
    """Whether a calibration may do without."""

    @property
    def done(self) -> bool:
        """Whether it suffices."""
        return self.progress >= 1


@dataclass(frozen=True)
class CaptureEvent:
    """The last capture that was taken or refused; the page sounds once for each number."""

    number: int = 0
    taken: bool = False
    text: str = ""
    """"Capture 12: camera, lidar", or why none was taken: "laser_left does not see the board"."""


@dataclass(frozen=True)
class RecorderState:
    """What has been recorded."""

    seconds: float = 0.0
    megabytes: float = 0.0
    messages: int = 0
    lost: int = 0
    """Messages that the source is known to have lost."""
    gaps: int = 0
    """How often the connection broke, in which unknown numbers of messages were lost."""
    minutes_left: float | None = None
    """Until the disk is full, at the present rate."""
    problem: str = ""


@dataclass(frozen=True, eq=False)
class SceneState:
    """The sensors in space; coordinates in the root frame, m."""

    sensors: tuple[SensorSolution, ...]
    """Those with poses."""
    boards: tuple[Array, ...] = ()
    """(4, 3): corners of the board in each capture, in order around its outline."""
    suggested: Array | None = None
    """(4, 3): where the board should be next."""
    floor: FloorGrid | None = None
    """Of a network, which is drawn from above."""


@dataclass(frozen=True)
class SessionState:
    """A session at one moment."""

    kind: Literal["rig", "network", "drive"]
    phase: Phase
    headline: str
    """One sentence: what the operator should do or wait for."""
    source: str = ""
    connected: bool = False
    automatic: bool = True
    """Whether captures are taken without the button."""
    root: str = ""
    sensors: tuple[SensorState, ...] = ()
    captures: int = 0
    event: CaptureEvent = field(default_factory=CaptureEvent)
    advice: Advice | None = None
    tolerance_mm: float = 0.0
    tolerance_degrees: float = 0.0
    done: bool = False
    """Whether all sensors are within tolerance."""
    notices: tuple[str, ...] = ()
    """The last ones, newest first."""
    recorder: RecorderState = field(default_factory=RecorderState)
    scene: SceneState | None = None
    """None before the first poses."""
    report: bool = False
    """Whether a report is there."""
    needs: tuple[Need, ...] = ()
    """Of a drive."""
