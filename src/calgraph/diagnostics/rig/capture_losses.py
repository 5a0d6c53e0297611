"""Captures that do not tie a sensor to others although both detected the board."""

from collections.abc import Iterator

import numpy as np

from calgraph.captures import CaptureSet
from calgraph.config.settings import RigDiagnosticsSettings
from calgraph.diagnostics.finding import Finding
from calgraph.estimation.rig.solution import SolvedBundle


def find_lost_captures(
    captures: CaptureSet, solved: SolvedBundle, settings: RigDiagnosticsSettings = RigDiagnosticsSettings()
) -> Iterator[Finding]:
    """Sensors that many of their shared captures do not tie to any other sensor.

    A capture is shared if another connected sensor detected the board as well. It is lost if the detection was an
    outlier of all pairs or of the joint solution, or those of all others were.

    Args:
        captures: all detections.
        solved: the joint solution.
        settings: the limits.
    """
    bundle = solved.bundle
    views = np.zeros(len(solved.captures), dtype=np.intp)
    for of_sensor in bundle.views:
        views[of_sensor.board] += 1
    for name, of_sensor in zip(bundle.sensors, bundle.views, strict=True):
        others = {c for other in bundle.sensors if other != name for c in captures.detections[other]}
        shared = others & set(captures.detections[name])
        tied = set(solved.captures[of_sensor.board[views[of_sensor.board] > 1]].tolist())
        lost = len(shared - tied)
        if shared and lost > settings.max_lost_share * len(shared):
            yield Finding(
                f"{lost} of {len(shared)} captures that {name} shares with other sensors were rejected: check "
                "that the board rests in each capture, that nothing in view is like it, and that clocks agree",
                (name,) if lost > settings.max_good_lost_share * len(shared) else (),
            )
