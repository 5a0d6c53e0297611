"""What connects the sensors of a rig: which of them still have to detect the board together, in words."""

from collections.abc import Collection
from dataclasses import dataclass

from calgraph.config import Rig
from calgraph.rig.captures.detect import CaptureSet

# How well a sensor alone locates the board: a partner that measures its plane needs the fewest shared captures.
_PARTNER_RANK = {"lidar3d": 0, "camera": 1, "lidar2d": 2}


def explain_unconnected(name: str, rig: Rig, captures: CaptureSet, connected: Collection[str]) -> str:
    """Why a sensor has no pose yet, as a sentence.

    Args:
        name: the sensor.
        rig: the rig.
        captures: the detections until now.
        connected: the sensors that have a pose, the root included.
    """
    if name in rig.cameras() and name not in captures.cameras:
        return f"the intrinsics of {name} are not known yet"
    if not captures.detections[name]:
        return f"{name} has not detected the board yet"
    shared = {other: _count_shared(captures, name, other) for other in rig.sensors if other != name}
    if not any(shared.values()):
        return f"{name} has not detected the board together with another sensor"
    within = {other: count for other, count in shared.items() if other in connected}
    if connected and not any(within.values()):
        others = ", ".join(other for other, count in shared.items() if count)
        return f"{name} has detected the board together with {others} only, which nothing connects to {rig.root}"
    counts = ", ".join(f"{count} with {other}" for other, count in (within or shared).items() if count)
    return f"{name} needs more captures together with other sensors, with the board tilted differently: {counts}"


@dataclass(frozen=True)
class MissingPair:
    """Two sensors that should detect the board together next."""

    sensors: tuple[str, str]
    """One without a pose, and one with a pose."""
    shared: int
    """Captures in which both have detected the board."""

    def __str__(self) -> str:
        """What the operator should do."""
        name, partner = self.sensors
        first = f"Show the board to {name} and {partner} together"
        if not self.shared:
            return f"{first}, in several places, tilted and turned differently each time"
        times = "once" if self.shared == 1 else f"{self.shared} times"
        return f"{first}, tilted and turned differently than before: they have detected it together {times}"


def find_missing_pair(rig: Rig, captures: CaptureSet, connected: Collection[str]) -> MissingPair | None:
    """Which sensors should detect the board together next, as long as some have no pose.

    Args:
        rig: the rig.
        captures: the detections until now.
        connected: the sensors that have a pose, the root included.

    Returns:
        The pair with the most common captures, of a sensor without a pose and one with a pose; None if all have
        one.
    """
    placed = {rig.root, *connected}
    missing = [name for name in rig.sensors if name not in placed]

    def rank(pair: MissingPair) -> tuple[int, int, int]:
        name, partner = pair.sensors
        kinds = _PARTNER_RANK[rig.sensors[name].kind] + _PARTNER_RANK[rig.sensors[partner].kind]
        return -pair.shared, kinds, missing.index(name)

    pairs = [
        MissingPair((name, partner), _count_shared(captures, name, partner))
        for name in missing
        for partner in sorted(placed)
    ]
    return min(pairs, key=rank, default=None)


def _count_shared(captures: CaptureSet, a: str, b: str) -> int:
    return len(captures.detections[a].keys() & captures.detections[b].keys())
