"""Messages of several sensors that belong together, from their stamps alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array


@dataclass(frozen=True, eq=False)
class StampGroup:
    """Messages of at least two sensors that were measured of one pose of the board."""

    stamps: Mapping[str, Array]
    """By sensor, its stamps in ascending order, s; no entry for a sensor without message in the group."""

    @property
    def start(self) -> float:
        """First stamp, s."""
        return min(float(stamps[0]) for stamps in self.stamps.values())

    @property
    def end(self) -> float:
        """Last stamp, s."""
        return max(float(stamps[-1]) for stamps in self.stamps.values())


def split_bursts(stamps: Array, max_gap: float) -> list[Array]:
    """Splits ascending stamps (N,) where more than ``max_gap``, s, lies between two of them."""
    return np.split(stamps, np.flatnonzero(np.diff(stamps) > max_gap) + 1) if len(stamps) else []


def group_bursts(bursts: Mapping[str, Sequence[Array]], max_gap: float, max_spread: float) -> list[StampGroup]:
    """Groups the bursts of several sensors so that a group has at most one burst of each.

    Groups are consecutive in time. As many bursts as possible are joined with the one before; of the groupings
    with that number, the one with the shortest gaps inside its groups is taken (dynamic programming over the
    bursts).

    Args:
        bursts: by sensor, the stamps of the messages that belong together, in order of time.
        max_gap: maximum time between a burst and the one before it in a group, s.
        max_spread: maximum time between the first stamps of the first and of the last burst of a group, s.

    Returns:
        The groups with at least two sensors, in order of time.
    """
    events = sorted(
        ((float(burst[0]), float(burst[-1]), name, burst) for name, all_ in bursts.items() for burst in all_),
        key=lambda event: event[:3],
    )
    # Of the best grouping of the first k events: (number of groups, sum of gaps, first event of the last group).
    best: list[tuple[int, float, int]] = [(0, 0.0, 0)]
    for k in range(1, len(events) + 1):
        options = []
        sensors: set[str] = set()
        gaps, first = 0.0, k - 1
        while True:
            sensors.add(events[first][2])
            groups, sum_of_gaps, _ = best[first]
            options.append((groups + 1, sum_of_gaps + gaps, first))
            if first == 0 or events[first - 1][2] in sensors:
                break
            gap = max(events[first][0] - events[first - 1][1], 0.0)
            if gap > max_gap or events[k - 1][0] - events[first - 1][0] > max_spread:
                break
            gaps, first = gaps + gap, first - 1
        best.append(min(options))
    groups_found = []
    k = len(events)
    while k:
        first = best[k][2]
        if k - first > 1:
            groups_found.append(StampGroup({name: burst for _, _, name, burst in events[first:k]}))
        k = first
    return groups_found[::-1]


def group_frames(stamps: Mapping[str, Array], max_spread: float) -> list[StampGroup]:
    """Sets of frames: at most one message of each sensor, all within ``max_spread``, s.

    Args:
        stamps: by sensor, ascending, s.
        max_spread: maximum time between the first and the last stamp of a set, s.
    """
    frames = {name: list(np.unique(one)[:, None]) for name, one in stamps.items()}
    return group_bursts(frames, max_spread, max_spread)


def measure_spread(groups: Sequence[StampGroup]) -> float:
    """Median time between the first and the last stamp of a group, s; 0 without groups."""
    return float(np.median([group.end - group.start for group in groups])) if groups else 0.0
