"""What connects the sensors of a rig: which of them still have to detect the board together, in words."""

from collections.abc import Collection, Iterator

from calgraph.captures import CaptureSet
from calgraph.config import Rig
from calgraph.live.state import Advice

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


def advise_on_missing_pairs(rig: Rig, captures: CaptureSet, connected: Collection[str]) -> Advice | None:
    """Which sensors should detect the board together next, as long as some have no pose.

    Args:
        rig: the rig.
        captures: the detections until now.
        connected: the sensors that have a pose, the root included.

    Returns:
        The pair that needs the fewest further captures, of a sensor without a pose and one with a pose; None if
        all have one.
    """
    pairs = list(_list_missing_pairs(rig, captures, {rig.root, *connected}))
    if not pairs:
        return None
    shared, _, _, name, partner = min(pairs)
    first = f"Show the board to {name} and {partner} together"
    if -shared == 0:
        return Advice(f"{first}, in several places, tilted and turned differently each time")
    times = "once" if shared == -1 else f"{-shared} times"
    return Advice(f"{first}, tilted and turned differently than before: they have detected it together {times}")


def _list_missing_pairs(
    rig: Rig, captures: CaptureSet, connected: Collection[str]
) -> Iterator[tuple[int, int, int, str, str]]:
    """Pairs of a sensor without a pose and one with a pose, sortable: those nearest to a relative pose first."""
    order = list(rig.sensors)
    for name, spec in rig.sensors.items():
        for partner in connected:
            if name not in connected:
                rank = _PARTNER_RANK[spec.kind] + _PARTNER_RANK[rig.sensors[partner].kind]
                yield -_count_shared(captures, name, partner), rank, order.index(name), name, partner


def _count_shared(captures: CaptureSet, a: str, b: str) -> int:
    return len(captures.detections[a].keys() & captures.detections[b].keys())
