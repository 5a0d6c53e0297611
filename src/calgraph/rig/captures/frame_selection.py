"""Which sets of frames of a moving board are captures."""

from collections.abc import Sequence

import numpy as np

from calgraph.geometry import Array
from calgraph.rig.captures.stamp_groups import StampGroup
from calgraph.rig.captures.timeline import RecordingTimeline, SensorTimes


def select_frame_sets(groups: Sequence[StampGroup], timeline: RecordingTimeline, limit: int) -> list[StampGroup]:
    """At most ``limit`` of the sets of frames, spread over the recording.

    Of each of ``limit`` equal parts of the recording, the set is taken that most sensors are part of, and of those
    with as many, the one in which the views change least: the board is slow there, and images are sharp.
    """
    if len(groups) <= limit:
        return list(groups)
    change = np.mean([_relative_activity(times, name, groups) for name, times in timeline.sensors.items()], axis=0)
    parts = np.array_split(np.arange(len(groups)), limit)
    return [groups[min(part, key=lambda i: (-len(groups[i].stamps), change[i]))] for part in parts]


def find_neighbours(groups: Sequence[StampGroup], timeline: RecordingTimeline) -> list[StampGroup]:
    """The messages of each sensor before and after those of some groups, as far as they are in none of them.

    They show the velocity of the board.
    """
    used = {(name, float(stamps[0])) for group in groups for name, stamps in group.stamps.items()}
    all_stamps = {name: np.unique(times.stamps) for name, times in timeline.sensors.items()}
    found = []
    for group in groups:
        for step in (-1, 1):
            stamps = {}
            for name, (stamp, *_) in group.stamps.items():
                i = int(np.searchsorted(all_stamps[name], stamp)) + step
                if 0 <= i < len(all_stamps[name]) and (name, float(all_stamps[name][i])) not in used:
                    used.add((name, float(all_stamps[name][i])))
                    stamps[name] = all_stamps[name][i : i + 1]
            if stamps:
                found.append(StampGroup(stamps))
    return found


def _relative_activity(times: SensorTimes, name: str, groups: Sequence[StampGroup]) -> Array:
    """(G,) change of a sensor's view at its frame of each group, over its median; 0 where it has none."""
    typical = float(np.median(times.activity)) if len(times.activity) else 0.0
    if typical == 0.0:
        return np.zeros(len(groups))
    by_stamp = dict(zip(times.stamps.tolist(), times.activity.tolist(), strict=True))
    return np.array([by_stamp[float(g.stamps[name][0])] / typical if name in g.stamps else 0.0 for g in groups])
