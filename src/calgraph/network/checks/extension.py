"""Extends the calibration of a network by recordings or scanners, with the earlier poses as a prior."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calgraph.config.settings import DiagnosticsSettings
from calgraph.errors import CalibrationError, InputError
from calgraph.geometry import Array
from calgraph.network.checks.moved_scanners import find_moved_scanners
from calgraph.network.joint.error_sources import EARLIER
from calgraph.network.joint.planar_poses import (
    NetworkPoses,
    ScannerPrior,
    build_scanner_prior,
    extract_planar_poses,
    extract_poses,
    lift_covariance,
)
from calgraph.result import Calibration, ErrorBudget, SensorPose, Verdict

EARLIER_WEIGHT = 0.5
"""Of the earlier poses, and of the recording, in the covariance of an extension. Errors of sensors that last, as
those of ranges and of stated heights, are the same in both: as if they were independent, standard deviations
would fall with each extension. With these weights the covariance is not too small for any correlation.

Source: Julier and Uhlmann, "A non-divergent estimation algorithm in the presence of unknown correlations", 1997.
"""
SHARED = "errors that both recordings share"
"""What the covariance of an extension is enlarged by."""


def extract_earlier_poses(earlier: Calibration, root: str, *, in_space: bool = False) -> NetworkPoses:
    """The poses of an earlier calibration of a network with this root.

    Raises:
        InputError: it has another root, or is not the calibration of a network of this kind.
    """
    if earlier.root != root:
        raise InputError(
            f"`extend`: its poses are in the frame of {earlier.root}, not {root}; "
            f"set root: {earlier.root} in rig.yaml"
        )
    poses = extract_poses(earlier, "`extend`: ") if in_space else extract_planar_poses(earlier, "`extend`: ")
    if in_space and poses.size == 3:
        raise InputError("`extend`: needs the calibration of a network of 3-D LiDARs, as this one is")
    return poses


def remove_scanners(earlier: Calibration, moved: Sequence[str]) -> Calibration:
    """An earlier calibration without the scanners that have moved since.

    Raises:
        InputError: one of them is not in the calibration, or is its root.
    """
    names = [sensor.name for sensor in earlier.sensors]
    for name in moved:
        if name not in names:
            raise InputError(f"`moved`: {name} is not in what is extended, which has {', '.join(sorted(names))}")
        if name == earlier.root:
            raise InputError(f"`moved`: {name} is the root; calibrate the network again, or with another root")
    kept = [k for k, name in enumerate(names) if name not in moved]
    rows = (6 * np.array(kept)[:, None] + np.arange(6)).ravel()
    return replace(
        earlier,
        sensors=tuple(
            replace(sensor, parent=earlier.root) if sensor.parent in moved else sensor
            for sensor in (earlier.sensors[k] for k in kept)
        ),
        joint_covariance=earlier.joint_covariance[np.ix_(rows, rows)],
        budget=None,
        evidence=replace(
            earlier.evidence,
            edges=tuple(
                edge
                for edge in earlier.evidence.edges
                if edge.sensor_a not in moved and edge.sensor_b not in moved
            ),
        ),
    )


def build_consistent_prior(
    earlier: NetworkPoses, found: NetworkPoses, root: str, settings: DiagnosticsSettings
) -> ScannerPrior:
    """The prior of earlier poses, provided that the recording alone does not contradict them.

    Args:
        earlier: the earlier poses.
        found: the poses of the scanners of the recording, from it alone, in the same frame.
        root: of the result; poses here are in the frame of the LiDAR that it was solved against.
        settings: of the test.

    Raises:
        CalibrationError: scanners have moved since; the message names them with their displacements.
    """
    names = found.names
    shared = [name for name in names if name in earlier.names]
    reference, moved = find_moved_scanners(earlier.select(shared), found, settings)
    if moved:
        moved_names = [one.name for one in moved]
        displacements = "; ".join(f"{one.name} has moved by {one}" for one in moved)
        advice = (
            "its root has moved: calibrate the network again"
            if root in moved_names
            else f"to estimate their poses again and keep the others, give `moved`: {', '.join(moved_names)}"
        )
        raise CalibrationError(
            f"the recording contradicts what is extended: relative to {reference}, {displacements}. "
            f"If so, {advice}"
        )
    return build_scanner_prior(earlier, names)


def merge_with_earlier(
    calibration: Calibration, earlier: Calibration, prior: ScannerPrior | None, factors: float | Array = 1.0
) -> Calibration:
    """A calibration with the scanners that only the earlier one has.

    Args as for :func:`merge_calibrations`.

    Raises:
        CalibrationError: nothing is connected to the root, so that there is no prior.
    """
    if prior is None:
        why = "; ".join(f"{name}: {reason}" for name, reason in calibration.evidence.unconnected.items())
        raise CalibrationError(
            f"nothing to extend with: no sensor is connected to the root {calibration.root} ({why})"
        )
    return merge_calibrations(calibration, earlier, prior, factors)


def merge_calibrations(
    found: Calibration, earlier: Calibration, prior: ScannerPrior, factors: float | Array = 1.0
) -> Calibration:
    """A calibration together with the scanners that only the earlier one has, which keep their poses.

    The errors of kept scanners are correlated with those of the others: the poses in ``found`` depend on the
    earlier ones by ``C W``, with its covariance ``C`` and the weighted information ``W`` of the prior. What tests
    of the recording multiplied ``C`` by is no part of that, except for what is of some scanners only: without it,
    the covariance might be indefinite.

    Args:
        found: from the recording and the prior.
        earlier: the earlier calibration.
        prior: of the solution ``found``.
        factors: of the variances of ``found`` by tests, of each scanner (S,) or of all.
    """
    now, before = extract_poses(found), extract_poses(earlier)
    kept = [sensor for sensor in earlier.sensors if sensor.name not in now.names]
    shared, kept_rows = [now.names[k] for k in prior.nodes], before.covariance_rows([one.name for one in kept])
    rows = now.covariance_rows(shared)
    scale = np.repeat(np.sqrt(np.broadcast_to(factors, len(now.names))), now.size)
    # Of all but the root, which has no error.
    of_prior = now.covariance[:, rows] / (scale[now.size :].min() * scale[rows])
    gain = of_prior @ (EARLIER_WEIGHT * prior.information)
    cross = gain @ before.covariance[np.ix_(before.covariance_rows(shared), kept_rows)]
    covariance = np.block([[now.covariance, cross], [cross.T, before.covariance[np.ix_(kept_rows, kept_rows)]]])
    names = (*now.names, *(sensor.name for sensor in kept))
    pairs = {frozenset((edge.sensor_a, edge.sensor_b)) for edge in found.evidence.edges}
    edges = (e for e in earlier.evidence.edges if frozenset((e.sensor_a, e.sensor_b)) not in pairs)
    sensors, joint_covariance = (
        (*found.sensors, *(_mark_kept(sensor) for sensor in kept)),
        covariance if now.size == 6 else lift_covariance(covariance),
    )
    T_root_sensor = [sensor.T_root_sensor for sensor in sensors]
    return replace(
        found,
        sensors=sensors,
        joint_covariance=joint_covariance,
        budget=_extend_budget(found.budget, joint_covariance, T_root_sensor) if found.budget else None,
        evidence=replace(
            found.evidence,
            edges=(*found.evidence.edges, *(e for e in edges if {e.sensor_a, e.sensor_b} <= set(names))),
            unconnected={name: why for name, why in found.evidence.unconnected.items() if name not in names},
        ),
    )


def _extend_budget(
    found: ErrorBudget, joint_covariance: Array, T_root_sensor: Sequence[Array]
) -> ErrorBudget | None:
    """The budget with kept scanners, whose errors are of the earlier calibration; None of large networks."""
    if found.covariance is None:
        return None
    sources = list(dict.fromkeys([*found.sources, EARLIER]))
    size, covariance = found.covariance.shape[1], np.zeros((len(sources), *joint_covariance.shape))
    covariance[: len(found.sources), :size, :size] = found.covariance
    covariance[sources.index(EARLIER)] += joint_covariance - covariance.sum(axis=0)
    return ErrorBudget.of_poses(sources, covariance, T_root_sensor)


def _mark_kept(sensor: SensorPose) -> SensorPose:
    """The sensor with a remark that its pose is the earlier one."""
    remark = "its pose is that of the earlier calibration: this recording does not determine it"
    before = sensor.verdict.reason
    reason = before if remark in before else f"{before}; {remark}" if before else remark
    return replace(sensor, verdict=Verdict(sensor.verdict.grade, reason))
