"""Trajectories of other programs in a drive: cleaned, split where they jump, and measured by relative motions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Rig
from calgraph.drive.measurements import Measurements
from calgraph.drive.relative_motions import gather_motions
from calgraph.drive.segments import Segments
from calgraph.drive.sources.source import Source, SourceKind, without_ranges
from calgraph.drive.start import MIN_SECOND_TURN, MOTION_DURATION, measure_turns
from calgraph.errors import Rejected
from calgraph.geometry import Array, Index, se_n, so3
from calgraph.sensors import Message, Pose, TransformList
from calgraph.sensors.kinds import TrajectorySpec
from calgraph.surfaces.sensor_states import SensorState
from calgraph.surfaces.trajectory import SplineTrajectory, Track

# Poses below which there is no motion to compare: at 5 Hz, those of 10 s.
_MIN_POSES = 50
# Time without a pose after which another segment begins, s: longer than between poses of 5 Hz.
_MAX_GAP = 0.5
# Segments that are shorter are not used, s: they have no two motions of the start.
_MIN_SEGMENT = 3.0
# What a step may differ from the mean of its neighbours beside noise, m and rad, and by accelerations, m/s² and
# rad/s²: those of wheeled robots and cars. Programs correct themselves by decimetres.
_MAX_STEP, _ACCELERATION = (0.03, 0.01), (5.0, 10.0)
# And in standard deviations of such differences: what slip and lost features have at times.
_MAX_DEVIATION = 12.0
# Largest height difference, m, and sine of roll and pitch of a planar trajectory: rounding.
_FLAT = 1e-4
# Largest tilt of trajectories that are used in a plane, rad: floors and frames are level to some degrees.
_MAX_TILT = 0.1
# Time between poses that are used, s: vehicles swing at 1 to 2 Hz.
STEP = 0.1
# Steps over which height, roll and pitch of a planar trajectory are taken as 0: several periods of a swing.
_LEVEL_STEPS = 25
# Time at the ends of a part that is left for changes of clocks, s.
_MARGIN = 0.2


class TrajectoryReader:
    """Keeps the poses of one frame."""

    def __init__(self, rig: Rig, name: str, dimension: int, _: np.random.Generator) -> None:
        spec = rig.sensors[name]
        assert isinstance(spec, TrajectorySpec)
        self._spec, self._dimension = spec, dimension
        self._poses: list[tuple[float, ...]] = []
        self._pairs: set[str] = set()

    def add(self, message: Message) -> None:
        """See :class:`Reader`."""
        if isinstance(message, Pose):
            self._poses.append((message.stamp, *message.position, *message.quaternion))
        elif isinstance(message, TransformList):
            for parent, pose in zip(message.parents, message.poses, strict=True):
                self._pairs.add(f"{pose.frame_id} in {parent}")
                if (parent, pose.frame_id) == (self._spec.parent, self._spec.frame_id):
                    self._poses.append((pose.stamp, *pose.position, *pose.quaternion))

    def finish(self) -> "MotionSource":
        """The poses, without those that are not usable."""
        rows = np.array(self._poses, dtype=np.float64).reshape(-1, 8)
        length = np.linalg.norm(rows[:, 4:], axis=1)
        # Some programs send zeros until they have a pose.
        usable = np.isfinite(rows).all(axis=1) & (length > 0.5) & (length < 2.0)
        rows, length = rows[usable], length[usable]
        _, first = np.unique(rows[:, 0], return_index=True)
        rows, length = rows[first], length[first]
        poses = se_n.pose(so3.from_quaternion(rows[:, 4:] / length[:, None]), rows[:, 1:4])
        planar = len(poses) > 0 and np.ptp(poses[:, 2, 3]) < _FLAT and np.abs(poses[:, 2, :2]).max() < _FLAT
        axes = np.arange(3 * self._dimension - 3)
        return MotionSource(self._split(rows[:, 0], poses), self._dimension, axes, bool(planar))

    def _split(self, times: Array, poses: Array) -> Segments | Rejected:
        """The poses (N, 4, 4) in segments, which end where they jump."""
        if len(times) < _MIN_POSES:
            there = ", ".join(sorted(self._pairs)) if not len(times) else ""
            there = f"; its topic has {there}: state frame_id and parent" if there else ""
            return Rejected(f"it has {len(times)} usable poses; a drive needs {_MIN_POSES}{there}")
        if self._dimension == 2:
            if np.quantile(np.hypot(poses[:, 2, 0], poses[:, 2, 1]), 0.9) >= np.sin(_MAX_TILT):
                return Rejected(
                    "its poses are not level, and 2-D scanners measure motion in a plane only: leave out either"
                )
            yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
            poses = se_n.pose(se_n.exp(yaw[:, None]), poses[:, :2, 3])
        segments = split_track(Track(times, poses), _find_jumps(times, poses), _MIN_SEGMENT)
        return segments or Rejected(f"its poses jump or have gaps: no {_MIN_SEGMENT:g} s are without")


def split_track(track: Track, ends: NDArray[np.bool_], shortest: float) -> Segments | None:
    """The segments of a track of N poses that ends after some of the first N - 1, of a least time, s."""
    parts = np.split(np.arange(len(track.times)), np.flatnonzero(ends) + 1)
    tracks = [Track(track.times[part], track.poses[part]) for part in parts]
    long = [one for one in tracks if one.times[-1] - one.times[0] >= shortest]
    return Segments(long) if long else None


@dataclass(frozen=True, eq=False)
class MotionSource(Source):
    """The motions of a sensor that measures no surroundings: by another program, or the turns of a gyroscope."""

    segments: Segments | Rejected
    """All poses, of a gyroscope without a place; or why there are none."""
    dimension: int
    axes: Index
    """Those of the n + d components of motions that are measured."""
    planar: bool = False
    """Whether it has no height, roll and pitch, as that of wheels."""

    @property
    def gap(self) -> float:
        """See :class:`Source`."""
        assert isinstance(self.segments, Segments)
        return float(np.median(np.concatenate([np.diff(one.times) for one in self.segments.tracks])))

    def track(self, rng: np.random.Generator) -> Segments | Rejected:  # noqa: ARG002
        """Means of the poses over half a step."""
        if isinstance(self.segments, Rejected):
            return self.segments
        return Segments([average_poses(one, STEP / 2) for one in self.segments.tracks])

    def measurements(self, k: int, trajectory: SplineTrajectory, state: SensorState) -> Sequence[Measurements]:
        """Relative motions over short intervals."""
        assert isinstance(self.segments, Segments)
        tracks = [average_poses(one, STEP) for one in self.segments.tracks]
        if self.dimension == 2 or not self.planar:
            return measure_motions(k, tracks, trajectory, state, self.axes, wheels=self.planar)
        # Wheels follow the floor: on the whole, height, roll and pitch do not change, but a body swings on them.
        level = [Track(one.times[::_LEVEL_STEPS], one.poses[::_LEVEL_STEPS]) for one in tracks]
        return (
            *measure_motions(k, tracks, trajectory, state, np.array([0, 1, 5]), wheels=True),
            *measure_motions(k, level, trajectory, state, np.array([2, 3, 4]), wheels=True),
        )


def measure_motions(
    k: int, tracks: Sequence[Track], trajectory: SplineTrajectory, state: SensorState, axes: Index, *, wheels: bool
) -> Sequence[Measurements]:
    """Motions from pose to pose of tracks within a part of the drive; see :func:`gather_motions`."""
    first, last = (t + state.clock_offset for t in (trajectory.start + _MARGIN, trajectory.end - _MARGIN))
    inside = [track.between(first, last) for track in tracks]
    starts, ends = (np.concatenate([one.times[some] for one in inside]) for some in (slice(-1), slice(1, None)))
    if len(starts) < 2:
        return ()
    motions = np.concatenate([se_n.inverse(one.poses[:-1]) @ one.poses[1:] for one in inside])
    undetermined = _find_undetermined(trajectory, state, axes, wheels=wheels)
    return (gather_motions(k, starts, ends, motions, axes, undetermined, wheels=wheels),)


def _find_undetermined(trajectory: SplineTrajectory, state: SensorState, axes: Index, *, wheels: bool) -> Array:
    """(n + d,) the change of the pose that motion about one axis does not determine, in the root's axes; or 0."""
    n = len(state.T_root_sensor) - 1
    change = np.zeros(n + n * (n - 1) // 2)
    if n == 2:
        return change
    if wheels:
        # Swings of a body, which are errors of planar motions, determine no height.
        change[:3] = state.T_root_sensor[:3, 2]
        return change
    times = np.arange(trajectory.start, trajectory.end - MOTION_DURATION, MOTION_DURATION / 3)
    before, after = (trajectory.at(some).poses for some in (times, times + MOTION_DURATION))
    turns, about = measure_turns(se_n.inverse(before) @ after)
    if turns[1] < MIN_SECOND_TURN:
        # The height of a trajectory, or the rotation of a gyroscope about the vertical.
        change[3 if axes.min() >= n else 0 :][:3] = about[0]
    return change


def average_poses(track: Track, step: float) -> Track:
    """Weighted means of the poses within a step, s, of evenly spaced times.

    Vibrations above half the rate of steps would look like slow motion otherwise, and another in each
    sensor.
    """
    place = (track.times - track.times[0]) / step
    before = np.floor(place).astype(np.intp)
    node = np.concatenate([before, before + 1])
    weight = np.concatenate([before + 1 - place, place - before])
    used = weight > 1e-3
    source, node, weight = np.tile(np.arange(len(place)), 2)[used], node[used], weight[used]
    nodes, index = np.unique(node, return_inverse=True)
    total = np.bincount(index, weight)
    # Rotations are averaged about the one nearest to the middle.
    order = np.lexsort((-weight, index))
    nearest = source[order][np.searchsorted(index[order], np.arange(len(nodes)))]
    R = se_n.rotation(track.poses)
    turn = se_n.log(se_n.transpose(R[nearest][index]) @ R[source])

    def mean(values: Array) -> Array:
        return np.stack([np.bincount(index, weight * column) / total for column in values.T], axis=1)

    return Track(
        mean(track.times[source, None])[:, 0],
        se_n.pose(R[nearest] @ se_n.exp(mean(turn)), mean(se_n.translation(track.poses)[source])),
    )


def _find_jumps(times: Array, poses: Array) -> NDArray[np.bool_]:
    """(N - 1,) steps between poses that no motion has, or that take too long."""
    n = poses.shape[-1] - 1
    duration = np.diff(times)
    moved = se_n.inverse(poses[:-1]) @ poses[1:]
    rates = se_n.difference(moved, np.eye(n + 1)) / duration[:, None]
    jumps = duration > _MAX_GAP
    if len(rates) < 4:
        return np.asarray(jumps)
    padded = np.concatenate([rates[1:2], rates, rates[-2:-1]])
    # Before and after: neighbours of a jump are between it and an ordinary step, and not less than both.
    deviation = (rates - np.median([padded[:-2], rates, padded[2:]], axis=0)) * duration[:, None]
    for part, limit, acceleration in zip(
        (deviation[:, :n], deviation[:, n:]), _MAX_STEP, _ACCELERATION, strict=True
    ):
        size = np.linalg.norm(part, axis=1)
        spread = np.sqrt(np.mean(np.sort(size**2)[: max(int(0.9 * len(size)), 1)]))
        jumps |= size > limit + acceleration * duration**2 + _MAX_DEVIATION * spread
    return np.asarray(jumps)


TRAJECTORY_SOURCE = SourceKind(TrajectoryReader, without_ranges)
