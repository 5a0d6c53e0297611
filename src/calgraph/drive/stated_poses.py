"""Poses that a file states: measurements beside the drive, of axes that it does not determine."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from calgraph.config import Rig
from calgraph.errors import InputError
from calgraph.geometry import Array, se_n
from calgraph.result.extrinsics_file import PriorFile
from calgraph.result.finding import Finding

# Least share of a prior's variance along an axis that the drive has to remove for it to test the prior.
_MIN_REDUNDANCY = 0.1
# Probability with which a right prior is named as wrong.
_FALSE_ALARM = 0.001


@dataclass(frozen=True, eq=False)
class StatedPose:
    """The pose of a sensor on the one that leads."""

    T: Array
    """(n+1, n+1)."""
    covariance: Array
    """(n + d, n + d) of its error along and about the axes of that sensor, m and rad."""


def resolve_stated_poses(
    rig: Rig, lead: str, frames: Mapping[str, str], prior: PriorFile | None, n: int
) -> dict[str, StatedPose]:
    """The poses, by sensor, that a file states against the sensor that leads.

    Args:
        rig: whose sensors the file may have.
        lead: name of the sensor that the others are solved against.
        frames: frame_id by sensor, as messages state it.
        prior: the file.
        n: dimension of the drive, 2 or 3.

    Raises:
        InputError: the file lacks the sensor that leads, or covariances, or states exact poses.
    """
    if prior is None:
        return {}
    if prior.stddev == (0, 0):
        raise InputError("prior: standard deviations must be above 0 for a robot that drives")
    ids = {name: spec.frame_id or frames.get(name) or name for name, spec in rig.sensors.items()}
    found, root = prior.poses.frames_of_sensors(ids), prior.poses.frame_of_sensor(lead, ids)
    axes = [0, 1, 5] if n == 2 else list(range(6))
    rows = [0, 1, 3] if n == 2 else list(range(4))
    stated = {}
    for name, frame in found.items():
        if name != lead:
            T, covariance = prior.state_pose(name, root, frame)
            stated[name] = StatedPose(T[np.ix_(rows, rows)], covariance[np.ix_(axes, axes)])
    return stated


def find_wrong_poses(
    stated: Mapping[str, StatedPose], used: Sequence[str], T: Sequence[Array], P: Sequence[Array]
) -> list[Finding]:
    """Stated poses that the solution contradicts.

    Args:
        stated: by sensor.
        used: names of the sensors in the solution.
        T: poses (n+1, n+1) of these,
        P: and their covariances (n + d, n + d), 0 where nothing is measured.

    Source: Baarda, "A testing procedure for use in geodetic networks", 1968.
    """
    found = []
    for name, pose, covariance in zip(used, T, P, strict=True):
        if name in stated:
            whiten = np.linalg.inv(np.linalg.cholesky(stated[name].covariance))
            error = whiten @ se_n.difference(pose, stated[name].T)
            redundancy, axes = np.linalg.eigh(np.eye(len(error)) - whiten @ covariance @ whiten.T)
            checked = redundancy > _MIN_REDUNDANCY
            squared = float(np.sum((axes.T @ error)[checked] ** 2 / redundancy[checked]))
            if checked.any() and squared > chdtri(int(checked.sum()), _FALSE_ALARM):
                text = (
                    f"the prior of {name} disagrees with the drive by {np.sqrt(squared):.1f} standard deviations; "
                    "correct the prior, or state larger standard deviations"
                )
                found.append(Finding(text, (name,)))
    return found
