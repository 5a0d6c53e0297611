"""The whole result as JSON, for scripts."""

from typing import Any

import numpy as np

from calgraph.geometry import so3
from calgraph.io.text_writing import format_json
from calgraph.result.calibration import Calibration
from calgraph.result.calibration_file import FORMAT, budget_deviations
from calgraph.result.correction import Correction
from calgraph.result.evidence import Edge
from calgraph.result.sensor_pose import BaseFrame, SensorPose


def to_json(calibration: Calibration) -> str:
    """The whole result, residuals, captures and pictures of boards and floors included, as one JSON object.

    Keys are those of calibration.yaml; what is not finite is null.
    """
    evidence, pictures = calibration.evidence, calibration.pictures
    return format_json({
        "format": FORMAT,
        "root": calibration.root,
        "estimator": evidence.estimator,
        "bodies": evidence.bodies and vars(evidence.bodies),
        "base": calibration.base and _base(calibration.base),
        "sensors": {sensor.name: _sensor(sensor) for sensor in calibration.sensors},
        "systematic": [vars(one) for one in calibration.systematic],
        "corrections": {name: _correction(one) for name, one in calibration.corrections.items()},
        "joint_covariance": _joint_covariance(calibration),
        "cross_covariances": _cross_covariances(calibration),
        "budget": _budget(calibration),
        "unconnected": dict(evidence.unconnected),
        "remarks": evidence.remarks,
        "fit": {name: vars(one) for name, one in evidence.fit.items()},
        "cross_validation": {name: vars(one) for name, one in evidence.cross_validation.items()},
        "suggestions": [vars(one) for one in evidence.suggestions],
        "remedies": [vars(one) for one in evidence.remedies],
        "edges": [_edge(edge) for edge in evidence.edges],
        "residual_rms": dict(evidence.residual_rms),
        "residuals": {kind: _round_residuals(values) for kind, values in evidence.residuals.items()},
        "captures": [vars(row) for row in evidence.captures],
        "outlines": [{"capture": one.capture, "corners": one.corners} for one in pictures.board_outlines],
        "floor": [
            {"sensor": view.sensor, "background": view.background, "walks": view.tracks}
            for view in pictures.floor_views
        ],
        "T_plan_root": pictures.T_plan_root,
    })  # fmt: skip


def _base(base: BaseFrame) -> dict[str, Any]:
    return {**vars(base), "verdict": vars(base.verdict)}


def _sensor(sensor: SensorPose) -> dict[str, Any]:
    T = sensor.T_root_sensor
    return {
        "parent": sensor.parent,
        "kind": sensor.kind,
        "frame_id": sensor.frame_id,
        "translation": T[:3, 3],
        "rotation": so3.quaternion(T[:3, :3]),
        "T_root_sensor": T,
        "covariance": sensor.covariance,
        "stated": sensor.stated and vars(sensor.stated),
        "intrinsics": sensor.intrinsics and sensor.intrinsics.model_dump(exclude_none=True),
        "clock_offset": sensor.clock_offset,
        "clock_offset_stddev": sensor.clock_offset_stddev,
        "verdict": vars(sensor.verdict),
    }


def _correction(one: Correction) -> dict[str, Any]:
    quantities = [parameter.quantity for parameter in one.parameters]
    return {"distance": one.distance, "parameters": quantities, "rings": one.rings, "covariance": one.covariance}


def _joint_covariance(calibration: Calibration) -> dict[str, Any] | None:
    if not calibration.has_correlations:
        return None
    return {"order": [sensor.name for sensor in calibration.sensors], "matrix": calibration.joint_covariance}


def _cross_covariances(calibration: Calibration) -> list[dict[str, Any]]:
    """Of pairs of sensors, where there is no joint covariance."""
    if calibration.has_correlations:
        return []
    names = [sensor.name for sensor in calibration.sensors]
    return [
        {"sensors": [names[a], names[b]], "covariance": calibration.cross_covariance(a, b)}
        for a, b in calibration.correlated_pairs.tolist()
    ]


def _budget(calibration: Calibration) -> list[dict[str, Any]]:
    """Standard deviations of all sensors but the root along their axes, by source."""
    if (budget := calibration.budget) is None:
        return []
    deviations = budget_deviations(budget, calibration)
    return [
        {"source": source.kind, "of": source.of, "stddev": stddev}
        for source, stddev in zip(budget.sources, deviations, strict=True)
    ]


def _edge(edge: Edge) -> dict[str, Any]:
    content = {**vars(edge), "residuals": _round_residuals(edge.residuals)}
    return {"sensors": [content.pop("sensor_a"), content.pop("sensor_b")], **content}


def _round_residuals(values: Any) -> list[float]:
    """Residuals with six digits, which is more than their accuracy."""
    return [float(f"{value:.6g}") for value in np.ravel(values)]
