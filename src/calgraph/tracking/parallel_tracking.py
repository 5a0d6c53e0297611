"""Many scanners followed side by side, by as many processes as there are to be."""

from collections.abc import Callable, Mapping, Sequence

from calgraph.config import Cylinder, People, RangeNoise
from calgraph.errors import Rejected
from calgraph.processes import parallel_map
from calgraph.tracking.features import Feature
from calgraph.tracking.scan_stack import ScanRun
from calgraph.tracking.track import Tracked
from calgraph.tracking.track_scanner import track_runs

# Fewer beams than these are followed before other processes have begun.
_WORTHWHILE = 500_000


def track_scanners(
    scans: Mapping[str, Sequence[ScanRun]],
    target: People | Cylinder,
    noise: Mapping[str, RangeNoise],
    *,
    feature: Feature = "nls",
    jobs: int = 1,
    progress: Callable[[float], None] = lambda _done: None,
) -> dict[str, Tracked | Rejected]:
    """Follows what moves through the view of each scanner, as :func:`calgraph.tracking.track_scanner` does.

    The result does not depend on the number of processes.

    Args:
        scans: by scanner.
        target: what moves.
        noise: by scanner.
        feature: how centres are measured.
        jobs: processes at most, see :func:`calgraph.processes.parallel_map`.
        progress: told how much is done, 0..1.

    Raises:
        CalibrationError: a process was killed.
    """
    beams = sum(run.ranges.size for runs in scans.values() for run in runs)
    work = [(runs, target, noise[name], feature) for name, runs in scans.items()]
    found = parallel_map(track_runs, work, jobs if beams > _WORTHWHILE else 1, progress)
    return dict(zip(scans, found, strict=True))
