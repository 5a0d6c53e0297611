"""Whether a recording can belong to a rig: what does not fit is named here, before it shows as missing boards."""

from collections.abc import Mapping

import numpy as np

from calgraph.captures.timeline import Timeline
from calgraph.config import Rig
from calgraph.errors import InputError

_MESSAGES: Mapping[str, tuple[str, ...]] = {
    "camera": ("Image",),
    "lidar2d": ("LaserScan", "PointCloud"),
    "lidar3d": ("PointCloud",),
}
_SENDERS = {"Image": "camera", "LaserScan": "lidar2d", "PointCloud": "lidar3d"}


def check_timeline(rig: Rig, timeline: Timeline, end: float) -> None:
    """Compares what a recording holds with what its rig says.

    Args:
        rig: the rig.
        timeline: of its sensors and triggers.
        end: end of the recording, s.

    Raises:
        InputError: a sensor's messages are of another kind, their stamps stand still or are of another time than
            the other sensors', the trigger is a sensor's topic, or the background window lies after the recording.
    """
    _check_windows(rig, end - timeline.start)
    _check_trigger(rig)
    for name in rig.sensors:
        _check_messages(name, rig, timeline)
        _check_stamps(name, timeline)


def _check_trigger(rig: Rig) -> None:
    for name, spec in rig.sensors.items():
        if spec.topic == rig.capture.trigger:
            raise InputError(
                f"capture.trigger: {spec.topic} is the topic of the sensor {name}, not one that marks captures; "
                "leave the trigger out to find the holds from the data"
            )


def _check_windows(rig: Rig, length: float) -> None:
    window = rig.capture.background
    if window and window[0] >= length:
        raise InputError(
            f"capture.background: [{window[0]:g}, {window[1]:g}] s lies after the end of the recording, which is "
            f"{length:.1f} s long"
        )


def _check_messages(name: str, rig: Rig, timeline: Timeline) -> None:
    spec, sent = rig.sensors[name], timeline.sensors[name].message
    if sent and sent not in _MESSAGES[spec.kind]:
        sender = f"; a {_SENDERS[sent]} sends those" if sent in _SENDERS else ""
        raise InputError(
            f"sensors.{name}.topic: {spec.topic} has {sent} messages{sender}, but its kind {spec.kind} needs "
            f"{' or '.join(_MESSAGES[spec.kind])}"
        )


def _check_stamps(name: str, timeline: Timeline) -> None:
    own = timeline.sensors[name].stamps
    if len(own) > 1 and own[0] == own[-1]:
        raise InputError(
            f"sensors.{name}: all its {len(own)} messages have the header stamp {own[0]:.3f} s; have its driver "
            "stamp them, or leave the sensor out"
        )
    others = [times.stamps for other, times in timeline.sensors.items() if other != name]
    elsewhere = np.concatenate([*others, timeline.triggers])
    if len(own) and len(elsewhere) and (own[-1] < elsewhere.min() or own[0] > elsewhere.max()):
        raise InputError(
            f"sensors.{name}: its header stamps run from {own[0]:.3f} to {own[-1]:.3f} s, those of the other "
            f"sensors and triggers from {elsewhere.min():.3f} to {elsewhere.max():.3f} s: their clocks differ"
        )
