"""The floor as the root of a network in space: poses over it, and what is not known of it.

Its origin is below a sensor that is the reference, and x is the heading of that, however it is tilted.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array, se3, se_n
from calgraph.network.joint.planar_poses import extract_poses
from calgraph.network.space.floor_plane import find_heading
from calgraph.network.space.observations import SpaceObservations
from calgraph.result import Calibration, SensorPose, Verdict
from calgraph.sensors.kinds import FLOOR


def spread_floor(T_floor_sensor: Sequence[Array], covariance: Array) -> Array:
    """(6S, 6S) errors of poses (4, 4) by those of roll, pitch and height (3, 3) of the first over the floor.

    The network turns with the heading of that.
    """
    T: Array = np.array(T_floor_sensor)
    x, _, z = T[0, :3, find_heading(T[0, 2, :3])]
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [z / x, 0.0, 0.0]])
    by_floor = np.zeros((len(T), 6, 3))
    by_floor[:, :3] = se_n.rotation_jacobian(T[:, :3, 3] - T[0, :3, 3]) @ turn
    by_floor[:, 2, 2] += 1.0
    by_floor[:, 3:] = turn
    flat = by_floor.reshape(-1, 3)
    return np.asarray(flat @ covariance @ flat.T)


def express_on_floor(calibration: Calibration, reference: SpaceObservations) -> Calibration:
    """A calibration whose root is the reference, with the floor as its root."""
    T_floor_root = reference.T_floor_sensor
    T = [T_floor_root @ one.T_root_sensor for one in calibration.sensors]
    turn = np.kron(np.eye(len(T)), se_n.rotation_adjoint(se_n.rotation(T_floor_root)))
    covariance = turn @ calibration.joint_covariance @ turn.T + spread_floor(T, reference.floor_covariance)
    floor = SensorPose(FLOOR.name, None, FLOOR.name, "floor", np.eye(4), Verdict("good"))
    sensors = [
        replace(one, parent=one.parent or FLOOR.name, T_root_sensor=pose)
        for one, pose in zip(calibration.sensors, T, strict=True)
    ]
    evidence, pictures = calibration.evidence, calibration.pictures
    return replace(
        calibration,
        root=FLOOR.name,
        sensors=(floor, *sensors),
        joint_covariance=np.pad(covariance, (6, 0)),
        evidence=replace(
            evidence, initial_poses={name: T_floor_root @ one for name, one in evidence.initial_poses.items()}
        ),
        pictures=replace(pictures, T_plan_root=np.asarray(pictures.T_plan_root @ se3.inverse(T_floor_root))),
    )


def leave_floor(calibration: Calibration, reference: str) -> Calibration:
    """A calibration whose root is the floor, with a sensor as its root, and without the floor.

    Raises:
        InputError: it has no such sensor.
    """
    by_name = {one.name: one for one in calibration.sensors if one.name != FLOOR.name}
    if reference not in by_name:
        raise InputError(
            f"`extend`: has no {reference}, the first 3-D LiDAR of rig.yaml, below which the floor's origin is; "
            f"list one of these first: {', '.join(by_name)}"
        )
    names = [reference, *(name for name in by_name if name != reference)]
    poses = extract_poses(calibration).change_root(reference).select(names)
    parents = {one.name: reference if one.parent == FLOOR.name else one.parent for one in calibration.sensors}
    sensors = [
        replace(by_name[name], parent=None if name == reference else parents[name], T_root_sensor=T)
        for name, T in zip(names, poses.T_root_scanner, strict=True)
    ]
    return replace(calibration, root=reference, sensors=tuple(sensors), joint_covariance=poses.covariance)
