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
    """The trajectory of a sensor in segments, in order of time.

    Motions are known within a world only.
    """

    tracks: Sequence[Track]
    """One at least, of two poses or more each, n = 2 or 3."""
    worlds: Sequence[int] = ()
    """Number of the world of each, where several segments are in one: a board that is detected again. All differ
    if empty."""

    @property
    def start(self) -> float:
        """Time of the first pose, s, by the sensor's clock."""
        return float(self.tracks[0].times[0])

    @property
    def end(self) -> float:
        """Time of the last pose, s."""
        return max(float(track.times[-1]) for track in self.tracks)

    @property
    def covered(self) -> float:
        """Time during which the pose is known, s."""
        return sum(float(track.times[-1] - track.times[0]) for track in self.tracks)

    def of_frame(self, T_sensor_frame: Array, clock_offset: float) -> "Segments":
        """The trajectory of another frame on the robot, by a clock that is ahead of the sensor's, s."""
        moved = [Track(one.times + clock_offset, one.poses @ T_sensor_frame) for one in self.tracks]
        return Segments(moved, self.worlds)

    def joined(self, other: "Segments") -> "Segments":
        """The segments of both, which are of one frame and clock, and have worlds in common."""
        order = np.argsort([one.times[0] for one in (*self.tracks, *other.tracks)], kind="stable")
        tracks, worlds = (*self.tracks, *other.tracks), (*self.worlds, *other.worlds)
        return Segments([tracks[k] for k in order], [worlds[k] for k in order])

    @cached_property
    def _rates(self) -> tuple[Array, Array]:
        """Times (M,), s, in the middle between two poses, and turn rates (M, d) in the sensor's frame, rad/s."""
        middle, rates = [], []
        for track in self.tracks:
            moved = se_n.log(se_n.rotation(se_n.inverse(track.poses[:-1]) @ track.poses[1:]))
            rates.append(moved / np.maximum(np.diff(track.times), 1e-3)[:, None])
            middle.append((track.times[:-1] + track.times[1:]) / 2)
        times = np.concatenate(middle)
        order = np.argsort(times, kind="stable")
        return times[order], np.concatenate(rates)[order]

    def turn_rates(self, times: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Turn rates (M,), rad/s, and whether they are known, at times (M,): not in long gaps between segments.

        They are signed in the plane, of any axis in space, where each sensor has other axes; before the first and
        after the last pose those of these.
        """
        middle, rates = self._rates
        size = rates[:, 0] if rates.shape[1] == 1 else np.linalg.norm(rates, axis=1)
        known = np.ones(len(times), dtype=bool)
        end = self.tracks[0].times[-1]
        for track in self.tracks[1:]:
            if track.times[0] - end > _MAX_GAP:
                known &= (times <= end) | (times >= track.times[0])
            end = max(end, track.times[-1])
        return np.asarray(np.interp(times, middle, np.clip(size, -_MAX_TURN_RATE, _MAX_TURN_RATE))), known

    def relative(self, starts: Array, duration: float) -> tuple[Array, NDArray[np.bool_]]:
        """Motions (M, n+1, n+1) ``T_start_end`` from starts (M,), s, and whether one world has both ends."""
        before, first = self._at(starts)
        after, last = self._at(starts + duration)
        return np.asarray(se_n.inverse(before) @ after), (first == last) & (first >= 0)

    def _at(self, times: Array) -> tuple[Array, NDArray[np.intp]]:
        """Poses (M, n+1, n+1), and numbers of their worlds; -1 where the pose is not known."""
        n = self.tracks[0].poses.shape[-1] - 1
        poses, world = np.tile(np.eye(n + 1), (len(times), 1, 1)), np.full(len(times), -1, dtype=np.intp)
        for k, track in enumerate(self.tracks):
            inside = (times >= track.times[0] - _TOLERANCE) & (times <= track.times[-1] + _TOLERANCE)
            poses[inside] = track.at(times[inside])
            world[inside] = self.worlds[k] if self.worlds else k
        return poses, world
