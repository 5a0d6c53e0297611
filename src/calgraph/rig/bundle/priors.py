"""Priors of poses: of a sensor with a covariance, or exact relative poses (rigid groups)."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from calgraph.config import Rig
from calgraph.config.settings import BoardPairSettings
from calgraph.errors import InputError
from calgraph.geometry import Array, Index, se3
from calgraph.graph.pairwise_estimate import PairwiseEstimate
from calgraph.graph.spanning_tree import SpanningTree, grow_tree
from calgraph.io.strict_model import StrictModel
from calgraph.result import ExtrinsicsFile
from calgraph.result.extrinsics_file import PriorFile
from calgraph.rig.bundle.bundle_parameters import SensorPrior
from calgraph.rig.bundle.bundle_solver import Bundle, BundleState
from calgraph.rig.bundle.observations import stack_poses
from calgraph.rig.captures.detect import CaptureSet

Row4 = tuple[float, float, float, float]
Row6 = tuple[float, float, float, float, float, float]


class PosePrior(StrictModel):
    """The prior of a sensor's pose."""

    sensor: str
    T_root_sensor: tuple[Row4, Row4, Row4, Row4]
    covariance: tuple[Row6, Row6, Row6, Row6, Row6, Row6]
    """Of its error in the root's fixed axes, (translation, rotation), m and rad."""
    source: str
    """The file that states it."""


class RigidGroup(StrictModel):
    """Sensors that are fixed to each other exactly as stated, two or more of them."""

    T_group_sensor: dict[str, tuple[Row4, Row4, Row4, Row4]]
    """By sensor; the frame is that of any of them."""
    source: str
    """The file that states it."""

    def propagate_pose(self, by: str, T_root_by: Array) -> Iterator[tuple[str, Array]]:
        """All sensors with their ``T_root_sensor`` (4, 4), given that of one of them."""
        T_by_group = se3.inverse(np.array(self.T_group_sensor[by]))
        for name, T_group_sensor in self.T_group_sensor.items():
            yield name, T_root_by @ T_by_group @ np.array(T_group_sensor) if name != by else T_root_by


@dataclass(frozen=True)
class RigidFile:
    """A file with exact relative poses of some sensors."""

    poses: ExtrinsicsFile
    sensors: tuple[str, ...]


def frame_id(sensor: str, rig: Rig, captured: CaptureSet) -> str:
    """The frame of a sensor: rig.yaml's, else that of its messages, else its name."""
    return rig.sensors[sensor].frame_id or captured.frames[sensor] or sensor


def resolve_prior_poses(
    rig: Rig, captured: CaptureSet, prior: PriorFile | None, rigid: Sequence[RigidFile]
) -> tuple[tuple[PosePrior, ...], tuple[RigidGroup, ...]]:
    """The priors and rigid groups that files state of a rig's sensors.

    Raises:
        InputError: a file lacks a required sensor or a covariance, or a sensor is in two groups.
    """
    frames = {name: frame_id(name, rig, captured) for name in rig.sensors}
    groups = [_resolve_group(file.poses, file.sensors, frames) for file in rigid]
    priors: list[PosePrior] = []
    if prior is not None:
        found = prior.poses.frames_of_sensors(frames)
        root = prior.poses.frame_of_sensor(rig.root, frames)
        if prior.stddev == (0, 0):
            groups.append(_resolve_group(prior.poses, (rig.root, *(n for n in found if n != rig.root)), frames))
        else:
            priors = [
                _resolve_prior(prior, name, root, frame) for name, frame in found.items() if name != rig.root
            ]
    _check_groups(groups, rig)
    return tuple(priors), tuple(groups)


def attach_by_priors(
    tree: SpanningTree,
    estimates: Sequence[PairwiseEstimate],
    priors: Sequence[PosePrior],
    groups: Sequence[RigidGroup],
    max_stddev: float = BoardPairSettings().max_stddev,
) -> SpanningTree:
    """The tree with the sensors that priors or groups connect to it, and those that captures connect to these.

    A pair does not observe directions of a standard deviation (m or rad) above ``max_stddev``.
    """
    from_groups = (
        (name, by, T)
        for group in groups
        for by in tree.T_root_sensor
        if by in group.T_group_sensor
        for name, T in group.propagate_pose(by, tree.T_root_sensor[by])
    )
    from_priors = ((prior.sensor, tree.root, np.array(prior.T_root_sensor)) for prior in priors)
    for name, parent, T in chain(from_groups, from_priors):
        if name not in tree.T_root_sensor:
            extended = SpanningTree(tree.root, {**tree.parents, name: parent}, {**tree.T_root_sensor, name: T})
            return attach_by_priors(
                grow_tree(extended, estimates, max_stddev), estimates, priors, groups, max_stddev
            )
    return tree


def apply_rigid_groups(state: BundleState, names: Sequence[str], groups: Sequence[RigidGroup]) -> BundleState:
    """The state with exact relative poses within groups, from the pose of the first sensor of each."""
    poses = dict(zip(names, state.T_root_sensor, strict=True))
    for group in groups:
        by = next((name for name in names if name in group.T_group_sensor), None)
        if by is not None:
            poses |= {name: T for name, T in group.propagate_pose(by, poses[by]) if name in poses}
    return replace(state, T_root_sensor=stack_poses([poses[name] for name in names]))


def with_priors(bundle: Bundle, priors: Sequence[PosePrior], groups: Sequence[RigidGroup]) -> Bundle:
    """The bundle with priors and rigid groups of its sensors."""
    sensor_priors = tuple(
        SensorPrior(
            bundle.sensors.index(p.sensor), np.array(p.T_root_sensor), np.linalg.inv(np.array(p.covariance))
        )
        for p in priors
    )
    return replace(bundle, body=assign_bodies(bundle.sensors, groups), priors=sensor_priors)


def without_priors(bundle: Bundle) -> Bundle:
    """The bundle without priors and groups; sensors without observations are fixed."""
    observed = np.array([len(views.board) > 0 for views in bundle.views])
    observed[0] = False
    return replace(bundle, body=np.where(observed, np.cumsum(observed), 0), priors=())


def assign_bodies(names: Sequence[str], groups: Sequence[RigidGroup]) -> Index:
    """(S,) index of each sensor's rigid body, in the order of their first sensors."""
    group_of = {name: i for i, group in enumerate(groups) for name in group.T_group_sensor}
    label = [("group", group_of[name]) if name in group_of else ("sensor", i) for i, name in enumerate(names)]
    number = {body: i for i, body in enumerate(dict.fromkeys(label))}
    return np.array([number[body] for body in label], dtype=np.intp)


def _resolve_group(poses: ExtrinsicsFile, sensors: Sequence[str], frames: Mapping[str, str]) -> RigidGroup:
    unknown = [name for name in sensors if name not in frames]
    if unknown:
        raise InputError(
            f"there is no sensor {', '.join(unknown)} to be in a rigid group; rig.yaml has {', '.join(frames)}"
        )
    if len(set(sensors)) < 2:
        raise InputError(f"a rigid group needs two sensors at least, got {', '.join(sensors) or 'none'}")
    first, *others = (poses.frame_of_sensor(name, frames) for name in sensors)
    T: dict[str, Array] = {sensors[0]: np.eye(4)} | {
        name: poses.transform(first, frame) for name, frame in zip(sensors[1:], others, strict=True)
    }
    return RigidGroup(T_group_sensor={name: T_a_b.tolist() for name, T_a_b in T.items()}, source=str(poses.path))


def _resolve_prior(file: PriorFile, name: str, root: str, frame: str) -> PosePrior:
    T_root_sensor, covariance = file.state_pose(name, root, frame)
    return PosePrior(
        sensor=name, T_root_sensor=T_root_sensor.tolist(), covariance=covariance.tolist(),
        source=str(file.poses.path),
    )  # fmt: skip


def _check_groups(groups: Sequence[RigidGroup], rig: Rig) -> None:
    for name in rig.sensors:
        within = [group.source for group in groups if name in group.T_group_sensor]
        if len(within) > 1:
            raise InputError(f"{name} is in {len(within)} rigid groups ({', '.join(within)}); one is allowed")
