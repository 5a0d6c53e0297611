"""More recordings, or scanners, for a network that is calibrated already, without starting over."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calgraph.diagnostics.network.moved_scanners import displacements
from calgraph.errors import CalibrationError, InputError
from calgraph.estimation.network.estimate import JointNetwork
from calgraph.estimation.network.planar_poses import PlanarPoses, planar_poses
from calgraph.estimation.network.scanner_prior import ScannerPrior, prior_of
from calgraph.result import Calibration, SensorPose, Verdict

# Chance of calling a scanner moved in a network in which none has.
_CHANCE = 1e-3


def earlier_poses(old: Calibration, root: str) -> PlanarPoses:
    """The poses of an earlier calibration of a network that has this root.

    Raises:
        InputError: it has another root, or is not a network's.
    """
    if old.root != root:
        raise InputError(
            f"--extend: its poses are in the frame of {old.root}, not {root}; set root: {old.root} in rig.yaml"
        )
    try:
        return planar_poses(old)
    except InputError as error:
        raise InputError(f"--extend: {error}") from error


def without(old: Calibration, moved: Sequence[str]) -> Calibration:
    """An earlier calibration that has forgotten some scanners, which are to be found anew.

    Raises:
        InputError: it does not know one of them, or is in the frame of one.
    """
    known = [sensor.name for sensor in old.sensors]
    for name in moved:
        if name not in known:
            raise InputError(f"--moved: {name} is not in what is extended, which has {', '.join(sorted(known))}")
        if name == old.root:
            raise InputError(f"--moved: {name} is the root; calibrate the network anew, or with another root")
    kept = [k for k, name in enumerate(known) if name not in moved]
    rows = (6 * np.array(kept)[:, None] + np.arange(6)).ravel()
    joint = old.joint_covariance
    return replace(
        old,
        sensors=tuple(
            replace(sensor, parent=old.root) if sensor.parent in moved else sensor
            for sensor in (old.sensors[k] for k in kept)
        ),
        edges=tuple(edge for edge in old.edges if edge.sensor_a not in moved and edge.sensor_b not in moved),
        joint_covariance=None if joint is None else joint[np.ix_(rows, rows)],
    )


def agreed_prior(known: PlanarPoses, names: Sequence[str], joint: JointNetwork) -> ScannerPrior:
    """What earlier poses say of scanners, if what a recording says without them does not contradict it.

    Args:
        known: the earlier poses.
        names: scanners of the recording, the root first.
        joint: their joint solution, from the recording alone.

    Raises:
        CalibrationError: scanners have moved since; the message names them, and says how far.
    """
    found = PlanarPoses(tuple(names), joint.T_root_scanner, joint.pose_covariance)
    shared = [name for name in names if name in known.names]
    still, moved = displacements(known.of(shared), found, _CHANCE)
    if moved:
        said = "; ".join(f"{one.name} has moved by {one}" for one in moved)
        flags = " ".join(f"--moved {one.name}" for one in moved)
        advice = (
            "its root has moved: calibrate the network anew"
            if names[0] in [one.name for one in moved]
            else f"to find what has moved anew, and keep the others, add {flags}"
        )
        raise CalibrationError(
            f"the recording contradicts what is extended: seen from {still}, {said}. If so, {advice}"
        )
    return prior_of(known, names)


def extended(found: Calibration, old: Calibration, prior: ScannerPrior) -> Calibration:
    """A calibration together with the scanners that only the earlier one has, which stay where they were.

    Their errors go together with those of the scanners that both have: ``found`` depends on the earlier errors by
    ``C W``, where ``C`` is its covariance and ``W`` the prior's information.

    Args:
        found: from the recording and the prior.
        old: the earlier calibration.
        prior: that ``found`` was solved with.
    """
    now, then = planar_poses(found), planar_poses(old)
    kept = [sensor for sensor in old.sensors if sensor.name not in now.names]
    both, old_rows = [now.names[k] for k in prior.nodes], then.rows([sensor.name for sensor in kept])
    gain = now.covariance[:, now.rows(both)] @ prior.information
    cross = gain @ then.covariance[np.ix_(then.rows(both), old_rows)]
    spread = np.block([[now.covariance, cross], [cross.T, then.covariance[np.ix_(old_rows, old_rows)]]])
    names = (*now.names, *(sensor.name for sensor in kept))
    poses = np.concatenate([now.T_root_scanner, then.T_root_scanner[old_rows[::3] // 3]])
    pairs = {frozenset((edge.sensor_a, edge.sensor_b)) for edge in found.edges}
    before = (e for e in old.edges if frozenset((e.sensor_a, e.sensor_b)) not in pairs)
    return replace(
        found,
        sensors=(*found.sensors, *(_kept(sensor) for sensor in kept)),
        edges=(*found.edges, *(e for e in before if {e.sensor_a, e.sensor_b} <= set(names))),
        unconnected={name: why for name, why in found.unconnected.items() if name not in names},
        joint_covariance=PlanarPoses(names, poses, spread).in_space()[1],
    )


def _kept(sensor: SensorPose) -> SensorPose:
    said = "its pose is that of the earlier calibration: this recording does not tell it"
    before = sensor.verdict.reason
    reason = before if said in before else f"{before}; {said}" if before else said
    return replace(sensor, verdict=Verdict(sensor.verdict.grade, reason))
