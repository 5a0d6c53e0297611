"""Trajectories with gaps: a camera that detects one board after another, a program that lost its place."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se_n
from calgraph.surfaces.trajectory import Track

# Time between segments over which turn rates are interpolated, s: a camera that misses some images of a board.
_MAX_GAP = 0.5
# Turn rates above this are failures of odometry, rad/s.
_MAX_TURN_RATE = 3.0
# Times that are outside of a segment by rounding only, s.
_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class Segments:
    """The trajectory of a sensor in segments, in order of time; each has a separate world.

    Motions are known within a segment only.
    """

    tracks: Sequence[Track]
    """One at least, of two poses or more each, n = 2 or 3."""

    @property
    def start(self) -> float:
        """Time of the first pose, s, by the sensor's clock."""
        return float(self.tracks[0].times[0])

    @property
    def end(self) -> float:
        """Time of the last pose, s."""
        return float(self.tracks[-1].times[-1])

    @cached_property
    def _rates(self) -> tuple[Array, Array]:
        """Times (M,), s, in the middle between two poses, and turn rates (M, d) in the sensor's frame, rad/s."""
        middle, rates = [], []
        for track in self.tracks:
            moved = se_n.log(se_n.rotation(se_n.inverse(track.poses[:-1]) @ track.poses[1:]))
            rates.append(moved / np.maximum(np.diff(track.times), 1e-3)[:, None])
            middle.append((track.times[:-1] + track.times[1:]) / 2)
        return np.concatenate(middle), np.concatenate(rates)

    def turn_rates(self, times: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Turn rates (M,), rad/s, and whether they are known, at times (M,): not in long gaps between segments.

        They are signed in the plane, of any axis in space, where each sensor has other axes; before the first and
        after the last pose those of these.
        """
        middle, rates = self._rates
        size = rates[:, 0] if rates.shape[1] == 1 else np.linalg.norm(rates, axis=1)
        known = np.ones(len(times), dtype=bool)
        for before, after in zip(self.tracks, self.tracks[1:], strict=False):
            if after.times[0] - before.times[-1] > _MAX_GAP:
                known &= (times <= before.times[-1]) | (times >= after.times[0])
        return np.asarray(np.interp(times, middle, np.clip(size, -_MAX_TURN_RATE, _MAX_TURN_RATE))), known

    def relative(self, starts: Array, duration: float) -> tuple[Array, NDArray[np.bool_]]:
        """Motions (M, n+1, n+1) ``T_start_end`` from starts (M,), s, and whether one segment has both ends."""
        n = self.tracks[0].poses.shape[-1] - 1
        motions, known = np.tile(np.eye(n + 1), (len(starts), 1, 1)), np.zeros(len(starts), dtype=bool)
        for track in self.tracks:
            inside = (starts >= track.times[0] - _TOLERANCE) & (starts + duration <= track.times[-1] + _TOLERANCE)
            motions[inside] = track.relative(starts[inside], duration)
            known |= inside
        return motions, known
