"""The calibrated tree in terms of frames, as ROS names them."""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from calgraph.errors import CalibrationError, InputError
from calgraph.geometry import Array, se3, so3
from calgraph.result.calibration import Calibration
from calgraph.result.sensor_pose import StatedPose


@dataclass(frozen=True, eq=False)
class TreeEdge:
    """One edge of the tree."""

    parent: str
    """Frame of the sensor nearer to the root."""
    child: str
    T_parent_child: Array
    """(4, 4)."""

    @property
    def xyz(self) -> Array:
        """(3,) the child's origin in the parent's frame, m."""
        return self.T_parent_child[:3, 3]

    @property
    def xyzw(self) -> Array:
        """(4,) unit quaternion."""
        return so3.quaternion(self.T_parent_child[:3, :3])


def frame_ids(calibration: Calibration) -> dict[str, str]:
    """The frame of each sensor, by the sensor's name, without the leading slash that tf2 refuses.

    Raises:
        InputError: a sensor has no frame, or two have the same.
    """
    by_sensor = {sensor.name: sensor.frame_id.lstrip("/") for sensor in calibration.sensors}
    for name, frame in by_sensor.items():
        if not frame:
            raise InputError(f"sensor {name!r} has no frame_id; give it one in rig.yaml (sensors.{name}.frame_id)")
    if calibration.base and calibration.base.frame in by_sensor.values():
        raise InputError(f"{calibration.base.frame!r} is the vehicle's frame, and that of a sensor, too")
    frame, count = Counter(by_sensor.values()).most_common(1)[0]
    if count > 1:
        same = [name for name in by_sensor if by_sensor[name] == frame]
        raise InputError(
            f"sensors {', '.join(same)} have the same frame_id {frame!r}, so that their transforms cannot be "
            f"distinguished; give them different ones in rig.yaml (sensors.{same[-1]}.frame_id)"
        )
    return by_sensor


def parent_to_root(calibration: Calibration) -> Calibration:
    """The same poses, with the root as the parent of every sensor.

    A driver may publish the frames below a sensor's frame, and its frame may have one parent only.
    """
    sensors = (s if s.parent is None else replace(s, parent=calibration.root) for s in calibration.sensors)
    return replace(calibration, sensors=tuple(sensors))


def keep_good_poses(calibration: Calibration) -> Calibration:
    """The root and the sensors whose verdict is good, each with the nearest of them in the tree as its parent.

    Raises:
        CalibrationError: no pose relative to the root is good.
    """
    parent_of = {sensor.name: sensor.parent for sensor in calibration.sensors}
    good = [k for k, s in enumerate(calibration.sensors) if s.parent is None or s.verdict.grade == "good"]
    base = calibration.base if calibration.base and calibration.base.verdict.grade == "good" else None
    if len(good) == 1 and base is None:
        raise CalibrationError("there is nothing to export: no pose is good")
    names = {calibration.sensors[k].name for k in good}
    sensors = []
    for k in good:
        parent = calibration.sensors[k].parent
        while parent is not None and parent not in names:
            parent = parent_of[parent]
        sensors.append(replace(calibration.sensors[k], parent=parent))
    rows = (6 * np.array(good)[:, None] + np.arange(6)).ravel()
    errors = calibration.prior_errors
    return replace(
        calibration,
        base=base,
        sensors=tuple(sensors),
        joint_covariance=calibration.joint_covariance[np.ix_(rows, rows)],
        prior_errors=errors and replace(errors, poses=errors.poses[rows]),
    )


def tree_edges(calibration: Calibration) -> list[TreeEdge]:
    """The edges of the tree, parents before their children; the vehicle's frame is above the root.

    Raises:
        InputError: as for :func:`frame_ids`.
    """
    frame_of = frame_ids(calibration)
    children: dict[str, list[str]] = {}
    for sensor in calibration.sensors:
        if sensor.parent is not None:
            children.setdefault(sensor.parent, []).append(sensor.name)
    base = calibration.base
    found = (
        [TreeEdge(base.frame, frame_of[calibration.root], base.complete())]
        if base is not None and base.known
        else []
    )
    waiting = [calibration.root]
    while waiting:
        parent = waiting.pop(0)
        for child in children.get(parent, []):
            found.append(TreeEdge(frame_of[parent], frame_of[child], calibration.transform(parent, child)))
            waiting.append(child)
    return found


def describe_origin(calibration: Calibration) -> str:
    """Where the transforms are from, for the comment of a file."""
    base = calibration.base
    if base is not None and base.known:
        axes = (
            f" {', '.join(base.missing)} of {calibration.root} in it: 0, as not measured." if base.missing else ""
        )
        origin = f"{base.frame} is on the floor below the centre of the {base.axle} axle.{axes}"
        return f"{describe_origin(replace(calibration, base=None))} {origin}"
    if not calibration.planar:
        return "Calibrated by calgraph."
    stated = any(sensor.stated for sensor in calibration.sensors)
    source = "as rig.yaml states them, or 0" if stated else "0, as rig.yaml does not state them"
    return f"Calibrated by calgraph. Height, roll and pitch were not measured: they are {source}."


def format_coordinate(value: float) -> str:
    """A coordinate as text: to 1e-13, and 0 for -0."""
    return repr(round(float(value), 13) + 0.0)


# A rotation by 180° about x.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def apply_stated_poses(calibration: Calibration) -> Calibration:
    """The calibration with the stated heights, rolls and pitches in its poses, for programs that need all axes.

    The height of a scanner relative to the root is zero unless both are stated.
    """
    if not calibration.planar or not any(sensor.stated for sensor in calibration.sensors):
        return calibration
    of_root = calibration[calibration.root].stated or StatedPose()
    T_level_root = _place(np.eye(4), of_root, of_root)
    sensors = []
    for sensor in calibration.sensors:
        inverted = of_root.inverted != bool(sensor.T_root_sensor[2, 2] < 0)
        stated = replace(sensor.stated or StatedPose(), inverted=inverted)
        flips = (_FLIP if one.inverted else np.eye(4) for one in (of_root, stated))
        T_level_sensor = _place(next(flips) @ sensor.T_root_sensor @ next(flips), stated, of_root)
        sensors.append(replace(sensor, T_root_sensor=se3.inverse(T_level_root) @ T_level_sensor))
    return replace(calibration, sensors=tuple(sensors))


def _place(T_level_upright: Array, stated: StatedPose, of_root: StatedPose) -> Array:
    """``T_level_sensor`` (4, 4) from the levelled, upright frame of the scanner, at the height of the root."""
    tilt = so3.exp(np.array([0.0, stated.pitch, 0.0])) @ so3.exp(np.array([stated.roll, 0.0, 0.0]))
    T = T_level_upright @ se3.pose(tilt, np.zeros(3)) @ (_FLIP if stated.inverted else np.eye(4))
    if stated.height is not None and of_root.height is not None:
        T[2, 3] += stated.height - of_root.height
    return np.asarray(T)
