"""Start values of all sensors: each against the one that leads, whose trajectory covers most of the time.

Cameras before boards cover little of it. Where all do, those that are connected serve the next ones together: they
have poses in the frames of the same boards.
"""

from collections.abc import Mapping

import numpy as np

from calgraph.drive.segments import Segments
from calgraph.drive.start import MotionStart, StartMotion, explain_failure, solve_start
from calgraph.errors import Rejected
from calgraph.geometry import se_n

# Share of the time that the best trajectory covers, with which the root's is taken: LiDARs start at other times.
_MIN_COVERAGE = 0.8
# Largest difference of clocks that is searched for, s.
_MAX_CLOCK_OFFSET = 0.6


def choose_lead(root: str, tracks: Mapping[str, Segments | Rejected]) -> str:
    """The sensor whose trajectory covers most of the time; the root, if it covers nearly as much."""
    covered = {name: 0.0 if isinstance(track, Rejected) else track.covered for name, track in tracks.items()}
    best = max(covered, key=lambda name: covered[name])
    return root if root in covered and covered[root] >= _MIN_COVERAGE * covered[best] else best


def solve_starts(
    lead: str, tracks: Mapping[str, Segments | Rejected], motions: Mapping[str, StartMotion], seed: int
) -> dict[str, MotionStart | Rejected]:
    """The start pose and clock of each sensor but the one that leads, against it, or why it has none.

    Args:
        lead: name of the sensor that leads.
        tracks: trajectory by sensor, or why it has none.
        motions: what each start is found from.
        seed: of random samples.
    """
    along = tracks[lead]
    if isinstance(along, Rejected):
        reason = f"the root {lead} has no trajectory: {along.reason}"
        return {
            name: track if isinstance(track, Rejected) else Rejected(reason)
            for name, track in tracks.items()
            if name != lead
        }
    found: dict[str, MotionStart | Rejected] = {}
    pending = [name for name in tracks if name != lead]
    rngs = {name: np.random.default_rng([seed, k, 2]) for k, name in enumerate(tracks)}
    while pending:
        tried = {name: _solve_start(along, name, tracks[name], motions[name], rngs[name]) for name in pending}
        found |= tried
        solved = {
            name: (start, track)
            for name, start in tried.items()
            if isinstance(start, MotionStart) and isinstance(track := tracks[name], Segments) and track.worlds
        }
        if not along.worlds or not solved:
            break
        # Of cameras, the one that moved most together with those that are connected is the next.
        best = max(solved, key=lambda name: solved[name][0].motions)
        start, track = solved[best]
        along = along.joined(track.of_frame(se_n.inverse(start.T_root_sensor), -start.clock_offset))
        pending.remove(best)
    return found


def _solve_start(
    along: Segments, name: str, track: Segments | Rejected, motion: StartMotion, rng: np.random.Generator
) -> MotionStart | Rejected:
    """The start pose and clock of a sensor against a trajectory, or why it has none."""
    if isinstance(track, Rejected):
        return track
    start = solve_start(along, track, _MAX_CLOCK_OFFSET, rng, motion)
    if isinstance(start, Rejected):
        return start
    failure = explain_failure(start, name, motion)
    return Rejected(failure) if failure else start
