"""How a robot that drives has moved so far, and what the drive still lacks."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from calgraph.config import Rig
from calgraph.drive.pipeline import dimension_of
from calgraph.drive.sources import SOURCES
from calgraph.drive.start import MIN_SECOND_TURN, MOTION_DURATION, measure_turns
from calgraph.errors import Rejected
from calgraph.geometry import Array, se_n
from calgraph.live.source import LiveMessage
from calgraph.live.state import Need

# Time between the starts of motions, s.
_STEP = 0.5
# Time after its first sweep in which odometry is without a velocity, s.
_SETTLING = 0.5
# What a calibration needs: time in which LiDARs pass surfaces enough (drives of benchmarks), s; a corner to each
# side, rad: circles leave open on which side of their centre a sensor is; and views from places apart, m.
_DURATION, _TURN, _TRAVEL = 30.0, np.pi / 2, 10.0


@dataclass(frozen=True, eq=False)
class DriveMotion:
    """Motions of one sensor of the robot, each over 1.5 s, which begin every half second."""

    starts: Array = field(default_factory=lambda: np.zeros(0))
    """(K,) s, by the sensor's clock."""
    motions: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    """(K, n+1, n+1) ``T_start_end``."""

    def joined(self, later: "DriveMotion") -> "DriveMotion":
        """With those of the time that follows."""
        motions = np.concatenate([self.motions, later.motions]) if len(self.motions) else later.motions
        return DriveMotion(np.append(self.starts, later.starts), motions)


def select_measuring(rig: Rig) -> str | None:
    """The sensor that motion is measured by: the root if it can be, else a LiDAR, a trajectory or a gyroscope."""
    flat = dimension_of(rig) == 2
    names = {
        name: SOURCES[spec.kind]
        for name, spec in rig.sensors.items()
        if SOURCES[spec.kind].make_reader and (flat or spec.kind != "lidar2d")
    }
    order = sorted(names, key=lambda one: (not names[one].has_place, one != rig.root, not names[one].has_surfaces))
    return order[0] if order else None


def measure_motions(
    rig: Rig, name: str, source: str, messages: Sequence[LiveMessage], after: float
) -> DriveMotion | Rejected:
    """The motions of a sensor by its odometry, as ``calgraph calibrate`` finds them.

    Args:
        rig: the robot.
        name: of the sensor.
        source: of the messages, for errors.
        messages: its last ones.
        after: motions begin later, s.
    """
    make_reader = SOURCES[rig.sensors[name].kind].make_reader
    assert make_reader
    reader = make_reader(rig, name, dimension_of(rig), np.random.default_rng(0))
    for message in messages:
        reader.add(message.read(source, rig.settings.limits).decode())
    track = reader.finish().track(np.random.default_rng(0))
    if isinstance(track, Rejected):
        return track
    first = max(after + _STEP / 2, track.start + _SETTLING)
    starts = _STEP * np.arange(np.ceil(first / _STEP), np.floor((track.end - MOTION_DURATION) / _STEP) + 1)
    motions, known = track.relative(starts, MOTION_DURATION)
    return DriveMotion(starts[known], motions[known])


def list_needs(rig: Rig, seconds: float, motion: DriveMotion, name: str | None) -> tuple[Need, ...]:
    """What a calibration needs of a drive, and how much of it there is; what is most urgent first.

    Args:
        rig: the robot.
        seconds: that were recorded.
        motion: so far, of a sensor whose z axis points upwards more than downwards.
        name: of this sensor; None if no sensor measures motion.
    """
    progress = f"{seconds:.0f} of {_DURATION:.0f} s"
    time = Need("Time", progress, seconds / _DURATION, f"drive on: {progress}")
    if name is None or not len(motion.starts):
        return (time,)
    turns = se_n.log(se_n.rotation(motion.motions))
    rms, axes = measure_turns(motion.motions)
    about = turns @ axes[0] * np.copysign(_STEP / MOTION_DURATION, axes[0, -1])
    needs = [
        _need_turn(
            f"Turned {side}", float(np.clip(sign * about, 0, None).sum()), _TURN, f"turn more to the {side}"
        )
        for side, sign in (("left", 1), ("right", -1))
    ]
    if SOURCES[rig.sensors[name].kind].has_place:
        way = float(np.linalg.norm(se_n.translation(motion.motions), axis=1).sum()) * _STEP / MOTION_DURATION
        needs.append(Need("Travelled", f"{way:.0f} of {_TRAVEL:.0f} m", way / _TRAVEL, "travel further"))
    if len(rms) == 3:
        ramp = "turn about another axis: drive over a ramp"
        needs.append(_need_turn("About another axis", float(rms[1]), MIN_SECOND_TURN, ramp, optional=True))
    return (*needs, time)


def _need_turn(label: str, turned: float, needed: float, advice: str, *, optional: bool = False) -> Need:
    digits = 1 if optional else 0
    text = f"{np.degrees(turned):.{digits}f} of {np.degrees(needed):.{digits}f}°"
    return Need(label, text, turned / needed, advice, optional)
