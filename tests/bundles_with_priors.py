"""Bundles of a simulated rig with priors and rigid groups of sensors, some of them wrong."""

from dataclasses import replace

import numpy as np

from bundle_scenes import Scene, scene
from calgraph.geometry import Array, se3
from calgraph.rig.bundle.bundle_parameters import SensorPrior
from calgraph.rig.bundle.bundle_solver import Bundle, MinimizedBundle, minimize_bundle
from calgraph.rig.bundle.priors import RigidGroup, apply_rigid_groups, assign_bodies

EXACT = scene(("lidar", "camera", "laser", "laser_2"), boards=8)
PAIR = ("laser", "laser_2")
# 20 mm and half a degree.
STDDEV = np.repeat([0.02, np.radians(0.5)], 3)


def group_of(exact: Scene, names: tuple[str, ...], wrong: Array | None = None) -> RigidGroup:
    """Sensors as they truly stand to each other, the last of them off by a step (6,)."""
    poses = {name: exact.truth.T_root_sensor[exact.bundle.sensors.index(name)] for name in names}
    if wrong is not None:
        poses[names[-1]] = se3.retract(poses[names[-1]], wrong)
    return RigidGroup.model_validate(
        {"T_group_sensor": {n: T.tolist() for n, T in poses.items()}, "source": "rig"}
    )


def grouped(bundle: Bundle, group: RigidGroup) -> MinimizedBundle:
    start = apply_rigid_groups(minimize_bundle(bundle, EXACT.truth).state, bundle.sensors, [group])
    return minimize_bundle(replace(bundle, body=assign_bodies(bundle.sensors, [group])), start)


def with_prior(bundle: Bundle, sensor: int, off: Array) -> Bundle:
    """The bundle with a prior that is off by a step (6,)."""
    T = se3.retract(EXACT.truth.T_root_sensor[sensor], off)
    return replace(bundle, priors=(SensorPrior(sensor, T, np.diag(STDDEV**-2)),))
