"""Captures that do not tie a sensor to others although both detected the board."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray

from calgraph.result.finding import Finding
from calgraph.rig.bundle.bundle_solver import Bundle
from calgraph.rig.bundle.solution import SolvedBundle
from calgraph.rig.captures.detect import CaptureSet


@dataclass(frozen=True, eq=False)
class _SharedCaptures:
    """The captures that a sensor shares with others, in the order of time."""

    lost: NDArray[np.bool_]
    """(N,) whether each is lost."""

    @property
    def lost_count(self) -> int:
        return int(self.lost.sum())

    @property
    def last_lost_count(self) -> int:
        """Number of lost captures after the last one that is not."""
        return len(self.lost) - 1 - int(np.flatnonzero(~self.lost).max(initial=-1))

    def chance_of_last_losses(self) -> float:
        """Probability that as many of the last captures are lost if those that are lost are drawn at random."""
        count, lost, last = len(self.lost), self.lost_count, self.last_lost_count
        return comb(count - last, lost - last) / comb(count, lost)


# Share of a sensor's shared captures that may be rejected without a remark.
_MAX_LOST_SHARE = 0.2
# The same beyond which a sensor is weak: RANSAC and robust estimates hold up to about half of outliers.
_MAX_GOOD_LOST_SHARE = 0.4


def find_lost_captures(captures: CaptureSet, solved: SolvedBundle) -> Iterator[Finding]:
    """Findings if many, or the last, of the captures that a sensor shares with others tie it to none of them.

    A capture is shared if another connected sensor detected the board as well. It is lost if the detection was an
    outlier of all pairs or of the joint solution, or those of all others were.

    Args:
        captures: all detections.
        solved: the joint solution.
    """
    bundle = solved.bundle
    shared = dict(zip(bundle.sensors, _list_shared_captures(captures, solved), strict=True))
    if losses := {n: s for n, s in shared.items() if s.lost_count > _MAX_LOST_SHARE * len(s.lost)}:
        parts = ", ".join(f"{one.lost_count} of {len(one.lost)} of {name}" for name, one in losses.items())
        weak = {n for n, s in losses.items() if s.lost_count > _MAX_GOOD_LOST_SHARE * len(s.lost)}
        yield Finding(
            f"captures that sensors share were rejected, {parts}: check that the board rests in each capture, "
            "that nothing in view is like it, and that clocks agree",
            _find_dependent_sensors(bundle, weak),
        )
    if last := {n: s for n, s in shared.items() if _are_last_lost(s)}:
        parts = ", ".join(f"{one.last_lost_count} of {len(one.lost)} of {name}" for name, one in last.items())
        yield Finding(
            f"the last captures that sensors share were rejected, {parts}: a sensor may have moved before them; "
            "fix the sensors to the robot, and record again",
            _find_dependent_sensors(bundle, last),
        )


def _list_shared_captures(captures: CaptureSet, solved: SolvedBundle) -> Iterator[_SharedCaptures]:
    """Those of each sensor."""
    bundle = solved.bundle
    views = np.zeros(len(solved.captures), dtype=np.intp)
    for of_sensor in bundle.views:
        views[of_sensor.board] += 1
    for name, of_sensor in zip(bundle.sensors, bundle.views, strict=True):
        others = {c for other in bundle.sensors if other != name for c in captures.detections[other]}
        shared = sorted(others & set(captures.detections[name]))
        tied = solved.captures[of_sensor.board[views[of_sensor.board] > 1]]
        yield _SharedCaptures(~np.isin(shared, tied))


# Minimum number of a sensor's last shared captures that are all rejected for it to be weak, as it may have been
# bumped before them: one wrong detection is more frequent than a bump before the last capture.
_MIN_LAST_LOSSES = 2
# Maximum probability that this number of the last ones is rejected if those that are rejected are drawn at
# random: 2 of 6 captures have 0.07, and the last 2 of 60 with 15 rejected 0.06. Lower limits miss bumps in short
# recordings.
_LAST_LOSSES_PROBABILITY = 0.1


def _are_last_lost(shared: _SharedCaptures) -> bool:
    """Whether as many of the last captures are lost as those that are lost at random rarely are.

    Without further captures after a bump, its captures are outliers of the pose before it.
    """
    return (
        shared.last_lost_count >= _MIN_LAST_LOSSES and shared.chance_of_last_losses() <= _LAST_LOSSES_PROBABILITY
    )


def _find_dependent_sensors(bundle: Bundle, inconsistent: Collection[str]) -> tuple[str, ...]:
    """Inconsistent sensors, and those that only these tie to the root: all if the root is inconsistent."""
    boards = {name: set(views.board.tolist()) for name, views in zip(bundle.sensors, bundle.views, strict=True)}
    tied, added = set[str](), {bundle.sensors[0]} - set(inconsistent)
    while added:
        tied |= added
        reached = set().union(*(boards[name] for name in added))
        added = {n for n in bundle.sensors if n not in tied and n not in inconsistent and boards[n] & reached}
    return tuple(name for name in bundle.sensors if name not in tied) if inconsistent else ()
