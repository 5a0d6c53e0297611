"""Changes of sensors' poses from recording to recording of a robot, and which of them moved."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from calgraph.config import ChangeRules
from calgraph.fleet.recording_result import PoseSet, RecordingResult
from calgraph.geometry import Array, se3
from calgraph.result.sensor_pose import UNMEASURED_IN_PLANE
from calgraph.verdict.displaced_nodes import estimate_displacements, find_displaced_nodes

_PLANAR = np.array([0, 1, 5])
# Standard deviation of the rounding of poses, m and rad; makes covariances regular.
_ROUNDING = 1e-6
Since = Literal["previous", "first", "reference"]


@dataclass(frozen=True, eq=False)
class Displacement:
    """How far a sensor is from where it was."""

    distance: float
    """Length of the translation, m."""
    distance_stddev: float
    angle: float
    """Of the rotation, rad."""
    angle_stddev: float

    @property
    def lengths(self) -> tuple[float, float, float, float]:
        """Distance and angle, each with its standard deviation."""
        return self.distance, self.distance_stddev, self.angle, self.angle_stddev


@dataclass(frozen=True, eq=False)
class SensorChange(Displacement):
    """Change of one sensor's pose in the frame of the root."""

    sensor: str
    step: Array
    """(6,) translation and rotation vector along the root's fixed axes, m and rad."""
    stddev: Array
    """(6,) of it, without errors that both recordings share; NaN where nothing was measured."""


@dataclass(frozen=True)
class Move(Displacement):
    """A sensor that moved relative to those that did not."""

    sensors: tuple[str, ...]
    """The sensor; several if the recordings do not determine which of them moved."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """The poses of two recordings of one robot."""

    since: Since
    earlier: str
    """The recording before, or ``reference``."""
    later: str
    changes: tuple[SensorChange, ...]
    moves: tuple[Move, ...]


@dataclass(frozen=True, eq=False)
class PosePair:
    """The poses of two recordings that are to be compared."""

    since: Since
    earlier: str
    later: str
    before: PoseSet
    after: PoseSet


def pair_recordings(results: Sequence[RecordingResult]) -> list[PosePair]:
    """What is compared of a robot's recordings: each with the one before, and with the reference or the first."""
    done = [(one.recording, one.poses, one.reference) for one in results if one.poses]
    pairs = [
        PosePair("previous", earlier, later, before, after)
        for (earlier, before, _), (later, after, _) in pairwise(done)
    ]
    pairs += [
        PosePair("reference", "reference", later, reference, after)
        for later, after, reference in done
        if reference
    ]
    if not any(reference for _, _, reference in done):
        pairs += [PosePair("first", done[0][0], later, done[0][1], after) for later, after, _ in done[2:]]
    return pairs


def compare_poses(pair: PosePair, rules: ChangeRules, false_alarm_probability: float) -> Comparison:
    """Changes of all sensors that both recordings have poses of, and those that moved.

    If the root has moved, all other sensors appear to have moved with it: the fewest sensors are named that
    explain the change.

    Args:
        pair: the poses.
        rules: when a sensor counts as moved.
        false_alarm_probability: of naming a sensor although none has moved.
    """
    names = [name for name in pair.before.names if name in pair.after.names]
    if not names or pair.before.names[0] != pair.after.names[0]:
        return Comparison(pair.since, pair.earlier, pair.later, (), ())
    before, after = pair.before.select(names), pair.after.select(names)
    difference = se3.difference(after.T_root_sensor, before.T_root_sensor)
    covariance = _difference_covariance(before, after, rules.common_variance)
    changes = tuple(
        _describe_change(name, difference[k], covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6])
        for k, name in enumerate(names)
        if k > 0
    )
    moves = _find_moves(names, before, difference, covariance, rules, false_alarm_probability)
    return Comparison(pair.since, pair.earlier, pair.later, changes, tuple(moves))


def _difference_covariance(before: PoseSet, after: PoseSet, common_variance: float) -> Array:
    """Covariance (6N, 6N) of the difference of two estimates, which share errors of what rig.yaml states."""
    covariance = before.covariance + after.covariance + _ROUNDING**2 * np.eye(6 * len(before.names))
    if before.prior_errors and after.prior_errors:
        common = common_variance * before.prior_errors.cross_covariance(after.prior_errors)
        covariance = covariance - common - common.T
    return np.asarray(covariance)


def _describe_change(name: str, step: Array, covariance: Array) -> SensorChange:
    with np.errstate(invalid="ignore"):
        stddev = np.sqrt(np.diag(covariance))
    unmeasured = np.isin(np.arange(6), UNMEASURED_IN_PLANE) & np.isnan(stddev)
    measured = np.where(unmeasured | unmeasured[:, None], 0.0, covariance)
    return SensorChange(*_measure(step, measured), name, step, stddev)


def _measure(step: Array, covariance: Array) -> tuple[float, float, float, float]:
    """The lengths of a displacement in space or in the plane, with their standard deviations."""
    n = 3 if len(step) == 6 else 2
    return *_measure_length(step[:n], covariance[:n, :n]), *_measure_length(step[n:], covariance[n:, n:])


def _measure_length(vector: Array, covariance: Array) -> tuple[float, float]:
    """Length of a vector, and its standard deviation; along the worst direction if it is zero."""
    length = float(np.linalg.norm(vector))
    if not np.isfinite(covariance).all():
        return length, float("inf")
    if length == 0.0:
        return 0.0, float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    along = vector / length
    return length, float(np.sqrt(max(float(along @ covariance @ along), 0.0)))


def _find_moves(
    names: Sequence[str],
    before: PoseSet,
    difference: Array,
    covariance: Array,
    rules: ChangeRules,
    false_alarm_probability: float,
) -> Iterator[Move]:
    """The fewest sensors that explain the difference, if they moved by more than brackets give."""
    diagonal = np.diag(covariance).reshape(-1, 6)
    # A network measures x, y and yaw in the plane that all its scanners scan.
    axes = _PLANAR if np.isnan(diagonal[1:, UNMEASURED_IN_PLANE]).all() else np.arange(6)
    known = np.flatnonzero(np.isfinite(diagonal[:, axes]).all(axis=1))
    rows = (6 * known[:, None] + axes).ravel()
    used = covariance[np.ix_(rows, rows)]
    if len(known) < 2 or not np.isfinite(used).all():
        return
    T, step = before.T_root_sensor[known], difference[np.ix_(known, axes)]
    if len(axes) == 3:
        T = T[:, [0, 1, 3]][:, :, [0, 1, 3]]
    found = find_displaced_nodes(
        T, step, used, false_alarm_probability, rules.max_sets, rules.indistinguishable_ratio
    )
    if not found[0]:
        return
    steps, spreads = estimate_displacements(T, step, used, found[0])
    others = [nodes for nodes in found[1:] if len(nodes) == 1]
    for node, displacement, spread in zip(found[0], steps, spreads, strict=True):
        sensors = tuple(names[known[k]] for k in (node, *(k for (k,) in others)))
        move = Move(*_measure(displacement, spread), sensors)
        if move.distance >= rules.min_translation or np.degrees(move.angle) >= rules.min_rotation:
            yield move
