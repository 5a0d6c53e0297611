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
    """A finding if many of the captures that a sensor shares with others do not tie it to any of them.

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
    losses: dict[str, tuple[int, int]] = {}
    for name, of_sensor in zip(bundle.sensors, bundle.views, strict=True):
        others = {c for other in bundle.sensors if other != name for c in captures.detections[other]}
        shared = others & set(captures.detections[name])
        tied = set(solved.captures[of_sensor.board[views[of_sensor.board] > 1]].tolist())
        if len(shared - tied) > settings.max_lost_share * len(shared):
            losses[name] = len(shared - tied), len(shared)
    if losses:
        parts = ", ".join(f"{lost} of {shared} of {name}" for name, (lost, shared) in losses.items())
        yield Finding(
            f"captures that sensors share were rejected, {parts}: check that the board rests in each capture, "
            "that nothing in view is like it, and that clocks agree",
            tuple(name for name, (lost, shared) in losses.items() if lost > settings.max_good_lost_share * shared),
        )
