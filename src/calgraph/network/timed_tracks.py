"""Tracks of scanners whose messages do not state when each beam was measured, with times that the tracks show."""

import numpy as np

from calgraph.config import Rig
from calgraph.errors import Rejected
from calgraph.network.graph.beam_times import recognize_beam_times
from calgraph.network.options import NetworkOptions
from calgraph.network.scanner_pairs import average_pairs, pair_scanners
from calgraph.network.track_recording import track_people
from calgraph.network.tracking.track import ScannerTracks
from calgraph.parallel.progress import Progress, no_progress
from calgraph.recording import Recording
from calgraph.recording.input_checks import InputMonitor
from calgraph.result.finding import Finding
from calgraph.sensors.untimed_scans import describe_turning

# Displacement of people within a scan below which times of beams do not matter, m: clocks take the mean of it, and
# what is left is half of it at most, the error that a pose may have by default.
_MAX_DISPLACEMENT = 0.02
# At which people walk, m/s.
_WALKING_SPEED = 1.4


def track_with_beam_times(
    rig: Rig,
    recording: Recording,
    options: NetworkOptions,
    progress: Progress = no_progress,
    monitor: InputMonitor | None = None,
) -> tuple[dict[str, ScannerTracks | Rejected], dict[str, str], tuple[Finding, ...]]:
    """Tracks and frames as of :func:`track_people`, and what was found about the times of beams.

    Scanners whose ``time_increment`` is zero although they turn are tracked again with the times of their beams.
    """
    tracks, frames = track_people(rig, recording, options, progress, monitor)
    tracked = {name: one for name, one in tracks.items() if isinstance(one, ScannerTracks)}
    untimed = {name: one.untimed for name, one in tracked.items() if one.untimed is not None}
    if not untimed:
        return tracks, frames, ()
    rng = np.random.default_rng(options.seed)
    corrected = pair_scanners(rig, tracked, options, rng, no_progress)
    start = average_pairs(rig, corrected, options.select_method(rig.settings.published), rng)
    turns = recognize_beam_times(corrected.tracked, start, corrected.inverted)
    findings: list[Finding] = []
    if turning := [name for name in untimed if turns.get(name)]:
        tracks, frames = track_people(rig, recording, options, progress, None, turns)
        periods = [untimed[name].period for name in turning]
        findings.append(Finding(describe_turning(turning, periods, "people are")))
    unknown = [name for name in untimed if name not in turns and _displacement(tracked[name]) > _MAX_DISPLACEMENT]
    if unknown:
        most = max(_displacement(tracked[name]) for name in unknown)
        findings.append(
            Finding(
                f"the scans of {', '.join(unknown)} have no times of beams (time_increment is 0), and the tracks "
                "do not show whether all are simultaneous: if not, people are displaced by up to "
                f"{1e3 * most:.0f} mm; set time_increment in the drivers, or let people walk longer where views "
                "overlap",
                tuple(unknown),
            )
        )
    return tracks, frames, tuple(findings)


def _displacement(tracked: ScannerTracks) -> float:
    """By which people move while a scanner turns through the bearings that it measured them at, m."""
    scans = tracked.untimed
    positions = [track.positions for track in tracked.tracks]
    if scans is None or not positions:
        return 0.0
    x = np.concatenate(positions)
    times = scans.turn_times(np.arctan2(x[:, 1], x[:, 0]))
    return _WALKING_SPEED * float(np.ptp(times))
