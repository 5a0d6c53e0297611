"""Calibrations of networks in space in the frame of another sensor, or of the floor.

A network is solved against a 3-D LiDAR, which measures the floor. The floor is a frame with a pose that is as
uncertain as roll, pitch and height of that LiDAR over it: its origin is below the LiDAR, and x is the heading of
that, however it is tilted.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calgraph.config import Lidar2dSpec, Lidar3dSpec, Rig
from calgraph.errors import InputError
from calgraph.geometry import Array, se3
from calgraph.network.checks.extension import remove_scanners
from calgraph.network.joint.planar_poses import NetworkPoses, extract_poses
from calgraph.network.space.floor_plane import find_heading
from calgraph.network.space.observations import SpaceObservations
from calgraph.result import Calibration, SensorPose, Verdict
from calgraph.sensors.kinds import FLOOR


def list_references(rig: Rig, earlier: Calibration | None) -> list[str]:
    """The 3-D LiDARs against which a network may be solved, the first that is connected to the root.

    Args:
        rig: the network.
        earlier: the calibration to extend, which has to have them, without the sensors that have moved since.

    Raises:
        InputError: it has none of them.
    """
    lidars = [name for name, spec in rig.sensors.items() if isinstance(spec, Lidar3dSpec)]
    of_scanner = isinstance(rig.sensors.get(rig.root), Lidar2dSpec)
    allowed = lidars if of_scanner else [rig.reference]
    if earlier is None:
        return allowed
    by_name = {one.name for one in earlier.sensors}
    known = [name for name in allowed if name in by_name]
    if known:
        return known
    if of_scanner:
        raise InputError(
            f"`extend`: has none of {', '.join(lidars)} where it was, and no other sensor measures the floor: "
            "calibrate the network again"
        )
    raise InputError(
        f"`extend`: has no {rig.reference}, the first 3-D LiDAR of rig.yaml, below which the floor's origin is; "
        f"list one of these first: {', '.join(name for name in lidars if name in by_name) or 'none'}"
    )


def spread_floor(T_floor_sensor: Array, covariance: Array) -> Array:
    """(6, 6) covariance of the pose (4, 4) of a sensor over the floor, of which x, y and yaw are as defined.

    Args:
        T_floor_sensor: the pose.
        covariance: (3, 3) of roll, pitch and height over the floor.
    """
    x, _, z = T_floor_sensor[:3, find_heading(T_floor_sensor[2, :3])]
    by_floor = np.zeros((6, 3))
    by_floor[2, 2] = 1.0
    # The network turns with the heading.
    by_floor[3:] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [z / x, 0.0, 0.0]]
    return np.asarray(by_floor @ covariance @ by_floor.T)


def express_on_floor(calibration: Calibration, observed: SpaceObservations) -> Calibration:
    """The calibration with the floor below its root, which the root measured, as the root."""
    T = observed.T_floor_sensor
    poses = extract_poses(calibration).express_in(FLOOR.name, T, spread_floor(T, observed.floor_covariance))
    floor = SensorPose(FLOOR.name, None, FLOOR.name, "floor", np.eye(4), Verdict("good"))
    sensors = [floor, *(replace(one, parent=one.parent or FLOOR.name) for one in calibration.sensors)]
    return _restate(calibration, poses, sensors, T)


def change_root(calibration: Calibration, root: str) -> Calibration:
    """The calibration in the frame of another of its sensors; its verdicts and clocks stay what they are."""
    if root == calibration.root:
        return calibration
    poses = extract_poses(calibration).change_root(root)
    by_name = {one.name: one for one in calibration.sensors}
    parents = {one.name: one.parent for one in calibration.sensors}
    # Edges on the way to the root point the other way round.
    child: str | None = None
    parent: str | None = root
    while parent is not None:
        above = parents[parent]
        parents[parent] = child
        child, parent = parent, above
    sensors = [replace(by_name[name], parent=parents[name]) for name in poses.names]
    return _restate(calibration, poses, sensors, poses.T_root_scanner[poses.names.index(calibration.root)])


def express_in_reference(calibration: Calibration, reference: str) -> Calibration:
    """The calibration in the frame of the LiDAR against which a network is solved, without the floor."""
    changed = change_root(calibration, reference)
    return remove_scanners(changed, [FLOOR.name]) if calibration.root == FLOOR.name else changed


def _restate(
    calibration: Calibration, poses: NetworkPoses, sensors: Sequence[SensorPose], T_new_old: Array
) -> Calibration:
    """The calibration with poses in another root, to which T_new_old maps; and its sensors in their order."""
    root, initial, pictures = poses.names[0], calibration.evidence.initial_poses, calibration.pictures
    from_old = se3.inverse(initial[root]) if root in initial else T_new_old
    return replace(
        calibration,
        root=root,
        sensors=tuple(replace(one, T_root_sensor=T) for one, T in zip(sensors, poses.T_root_scanner, strict=True)),
        joint_covariance=poses.covariance,
        evidence=replace(
            calibration.evidence, initial_poses={name: from_old @ one for name, one in initial.items()}
        ),
        pictures=replace(pictures, T_plan_root=np.asarray(pictures.T_plan_root @ se3.inverse(T_new_old))),
    )
