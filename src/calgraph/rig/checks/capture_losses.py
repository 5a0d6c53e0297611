"""Captures that do not tie a sensor to others although both detected the board."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import RigDiagnosticsSettings
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


def find_lost_captures(
    captures: CaptureSet, solved: SolvedBundle, settings: RigDiagnosticsSettings = RigDiagnosticsSettings()
) -> Iterator[Finding]:
    """Findings if many, or the last, of the captures that a sensor shares with others tie it to none of them.

    A capture is shared if another connected sensor detected the board as well. It is lost if the detection was an
    outlier of all pairs or of the joint solution, or those of all others were.

    Args:
        captures: all detections.
        solved: the joint solution.
        settings: the limits.
    """
    bundle = solved.bundle
    shared = dict(zip(bundle.sensors, _list_shared_captures(captures, solved), strict=True))
    if losses := {n: s for n, s in shared.items() if s.lost_count > settings.max_lost_share * len(s.lost)}:
        parts = ", ".join(f"{one.lost_count} of {len(one.lost)} of {name}" for name, one in losses.items())
        weak = {n for n, s in losses.items() if s.lost_count > settings.max_good_lost_share * len(s.lost)}
        yield Finding(
            f"captures that sensors share were rejected, {parts}: check that the board rests in each capture, "
            "that nothing in view is like it, and that clocks agree",
            _find_dependent_sensors(bundle, weak),
        )
    if last := {n: s for n, s in shared.items() if _are_last_lost(s, settings)}:
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


def _are_last_lost(shared: _SharedCaptures, settings: RigDiagnosticsSettings) -> bool:
    """Whether as many of the last captures are lost as those that are lost at random rarely are.

    Without further captures after a bump, its captures are outliers of the pose before it.
    """
    return (
        shared.last_lost_count >= settings.min_last_losses
        and shared.chance_of_last_losses() <= settings.last_losses_probability
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
