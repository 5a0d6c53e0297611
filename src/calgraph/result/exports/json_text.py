"""The whole result as JSON, for scripts."""

import json
from dataclasses import asdict
from typing import Any

import numpy as np

from calgraph.geometry import so3
from calgraph.result.calibration import Calibration
from calgraph.result.calibration_file import FORMAT
from calgraph.result.evidence import CaptureRow, Edge
from calgraph.result.sensor_pose import SensorPose


def to_json(calibration: Calibration) -> str:
    """The whole result, residuals, captures and what pictures show included, as one JSON object.

    Keys are those of calibration.yaml; what is not finite is null.
    """
    content = {
        "format": FORMAT,
        "root": calibration.root,
        "estimator": calibration.evidence.estimator,
        "sensors": {sensor.name: _sensor(sensor) for sensor in calibration.sensors},
        "estimated": [asdict(one) for one in calibration.estimated_parameters],
        "joint_covariance": _joint_covariance(calibration),
        "unconnected": dict(calibration.evidence.unconnected),
        "remarks": list(calibration.evidence.remarks),
        "cross_validation": {name: asdict(one) for name, one in calibration.evidence.cross_validation.items()},
        "suggestions": [
            {**vars(one), "T_root_board": _plain(one.T_root_board)} for one in calibration.evidence.suggestions
        ],
        "edges": [_edge(edge) for edge in calibration.evidence.edges],
        "residual_rms": _plain(dict(calibration.evidence.residual_rms)),
        "residuals": {kind: _plain(_rounded(values)) for kind, values in calibration.evidence.residuals.items()},
        "captures": [_capture(row) for row in calibration.evidence.captures],
        "outlines": [
            {"capture": outline.capture, "corners": _plain(outline.corners)}
            for outline in calibration.pictures.board_outlines
        ],
        "floor": [
            {
                "sensor": view.sensor,
                "background": _plain(view.background),
                "walks": [_plain(walk) for walk in view.tracks],
            }
            for view in calibration.pictures.floor_views
        ],
    }
    return json.dumps(content, ensure_ascii=False, allow_nan=False)


def _sensor(sensor: SensorPose) -> dict[str, Any]:
    T = sensor.T_root_sensor
    return {
        "parent": sensor.parent,
        "kind": sensor.kind,
        "frame_id": sensor.frame_id,
        "translation": _plain(T[:3, 3]),
        "rotation": _plain(so3.quaternion(T[:3, :3])),
        "T_root_sensor": _plain(T),
        "covariance": _plain(sensor.covariance),
        "clock_offset": _plain(sensor.clock_offset),
        "clock_offset_stddev": _plain(sensor.clock_offset_stddev),
        "verdict": {"grade": sensor.verdict.grade, "reason": sensor.verdict.reason},
    }


def _joint_covariance(calibration: Calibration) -> dict[str, Any] | None:
    if not calibration.has_correlations:
        return None
    order = [sensor.name for sensor in calibration.sensors]
    return {"order": order, "matrix": _plain(calibration.joint_covariance)}


def _edge(edge: Edge) -> dict[str, Any]:
    return {
        "sensors": [edge.sensor_a, edge.sensor_b],
        "captures": edge.captures,
        "inliers": edge.inliers,
        "in_tree": edge.in_tree,
        "residual_rms": _plain(edge.residual_rms),
        "residuals": _plain(_rounded(edge.residuals)),
        "note": edge.note,
    }


def _capture(row: CaptureRow) -> dict[str, Any]:
    return {
        "capture": row.capture,
        "start": _plain(row.start),
        "end": _plain(row.end),
        "sensor": row.sensor,
        "used": row.used,
        "reason": row.reason,
        "residual": _plain(row.residual),
    }


def _rounded(values: Any) -> list[float]:
    """Residuals with six digits, which is more than they mean."""
    return [float(f"{value:.6g}") for value in np.ravel(values)]


def _plain(value: Any) -> Any:
    """Numbers, mappings and arrays of numbers as JSON has them: NaN and infinities become None."""
    if value is None:
        return None
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item) for item in value]
    return float(value) if np.isfinite(value) else None
