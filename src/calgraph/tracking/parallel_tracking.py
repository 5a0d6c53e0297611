"""Tracking in many scanners in parallel."""

from collections.abc import Callable, Mapping, Sequence

from calgraph.config import Cylinder, People, RangeNoise
from calgraph.config.settings import TrackingSettings
from calgraph.engine import THIS_PROCESS, Engine
from calgraph.errors import Rejected
from calgraph.tracking.features import CenterEstimator
from calgraph.tracking.scan_stack import ScanRun
from calgraph.tracking.track import ScannerTracks
from calgraph.tracking.track_scanner import track_runs

# Fewer beams than these are processed faster than other processes start.
_MIN_PARALLEL_BEAMS = 500_000


def track_scanners(
    scans: Mapping[str, Sequence[ScanRun]],
    target: People | Cylinder,
    noise: Mapping[str, RangeNoise],
    *,
    centers: CenterEstimator | None = None,
    settings: TrackingSettings = TrackingSettings(),
    engine: Engine = THIS_PROCESS,
    progress: Callable[[float], None] = lambda _done: None,
) -> dict[str, ScannerTracks | Rejected]:
    """Tracks the moving objects of each scanner, as :func:`calgraph.tracking.track_scanner` does.

    The result does not depend on the engine.

    Args:
        scans: by scanner.
        target: what moves.
        noise: by scanner.
        centers: measures the centres of objects in place of the fit of ellipses.
        settings: of tracking.
        engine: evaluates scanners.
        progress: called with the fraction done, 0 to 1.

    Raises:
        CalibrationError: a process was killed.
    """
    beams = sum(run.ranges.size for runs in scans.values() for run in runs)
    work = [(runs, target, noise[name], centers, settings) for name, runs in scans.items()]
    chosen = engine if beams > _MIN_PARALLEL_BEAMS else THIS_PROCESS
    found = chosen.map(track_runs, work, progress)
    return dict(zip(scans, found, strict=True))
