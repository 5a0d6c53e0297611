"""Writing calibration.yaml, which other programs read, and captures.csv, one row per capture and sensor."""

import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml.comments import CommentedSeq

from calgraph.config import Intrinsics
from calgraph.geometry import Array, so3
from calgraph.io.atomic import write_atomically, write_text
from calgraph.io.text_writing import escape_formula, flow_sequence, format_yaml, format_yaml_number
from calgraph.result.base_frame import BaseFrame
from calgraph.result.budget import ErrorBudget
from calgraph.result.calibration import Calibration, Provenance
from calgraph.result.correction import Correction
from calgraph.result.estimated_parameter import EstimatedParameter
from calgraph.result.evidence import CaptureRow, Edge, FitError, HeldOutError, Remedy, Suggestion
from calgraph.result.sensor_pose import SensorPose, Verdict

FORMAT = "calgraph/1"
_HEADER = """\
Poses map coordinates in a sensor's frame to the root's: translation in metres, rotation as quaternion x, y, z, w.
covariance: of (x, y, z, rx, ry, rz) along the root's fixed axes, m and rad. joint_covariance: of all sensors,
one after the other, in the same axes; null: not measured. residual_rms of edges in m, of kinds
in standard deviations (1 as expected from the noise). budget: standard deviations along and about
the axes of each sensor, by source; their squares add up to the variances. base: of the root in the
frame of the vehicle, covariance in its axes.
"""
_CAPTURE_COLUMNS = ("capture", "start", "end", "sensor", "used", "reason", "residual")


def save_calibration(calibration: Calibration, path: Path | str) -> None:
    """Writes a calibration.yaml in one step.

    Residuals are summed up as their root mean squares; everything else comes back with :func:`load_calibration`.

    Raises:
        InputError: ``path`` cannot be written.
    """
    content: dict[str, Any] = {
        "format": FORMAT,
        "root": calibration.root,
        **({"base": _base(base)} if (base := calibration.base) else {}),
        "sensors": {sensor.name: _sensor(sensor) for sensor in calibration.sensors},
        "quality": _quality(calibration),
    }
    text = format_yaml(content, _HEADER) + _edges(calibration.evidence.edges)
    if calibration.systematic:
        text += format_yaml({"systematic": [_estimated_parameter(one) for one in calibration.systematic]})
    if calibration.corrections:
        text += format_yaml({"corrections": {n: _correction(one) for n, one in calibration.corrections.items()}})
    if calibration.has_correlations:
        order = flow_sequence(sensor.name for sensor in calibration.sensors)
        text += format_yaml({"joint_covariance": {"order": order}}) + _matrix(calibration.joint_covariance)
    else:
        text += _cross_covariances(calibration)
    if calibration.budget is not None:
        text += _budget(calibration.budget, calibration)
    if calibration.provenance:
        text += format_yaml({"provenance": _provenance(calibration.provenance)})
    write_text(Path(path), text)


def save_captures(calibration: Calibration, path: Path) -> None:
    """Writes captures.csv in one step: one row per capture and sensor: used, or why not.

    Raises:
        InputError: ``path`` cannot be written.
    """
    with write_atomically(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(_CAPTURE_COLUMNS)
        writer.writerows(_capture_row(row) for row in calibration.evidence.captures)


def _capture_row(row: CaptureRow) -> tuple[object, ...]:
    residual = "" if row.residual is None else f"{row.residual:.5f}"
    used = "yes" if row.used else "no"
    sensor, reason = escape_formula(row.sensor), escape_formula(row.reason)
    return row.capture, f"{row.start:.3f}", f"{row.end:.3f}", sensor, used, reason, residual


def _base(base: BaseFrame) -> dict[str, Any]:
    entry: dict[str, Any] = {"frame": base.frame, "axle": base.axle}
    if base.known:
        t, q = base.T_base_root[:3, 3], so3.quaternion(base.T_base_root[:3, :3])
        entry["translation"] = flow_sequence(None if np.isnan(x) else x for x in _round_digits(t, 15))
        entry["rotation"] = flow_sequence(_round_digits(q, 14))
        entry["covariance"] = _symmetric(base.covariance, 9)
    return {**entry, "verdict": _verdict(base.verdict)}


def _sensor(sensor: SensorPose) -> dict[str, Any]:
    entry: dict[str, Any] = {} if sensor.parent is None else {"parent": sensor.parent}
    entry["kind"] = sensor.kind
    entry["frame_id"] = sensor.frame_id
    # These digits keep poses to better than 1e-12 at any distance within a rig.
    entry["translation"] = flow_sequence(_round_digits(sensor.T_root_sensor[:3, 3], 15))
    entry["rotation"] = flow_sequence(_round_digits(so3.quaternion(sensor.T_root_sensor[:3, :3]), 14))
    entry["covariance"] = _symmetric(sensor.covariance, 9)
    if sensor.stated is not None:
        entry["stated"] = {key: value for key, value in asdict(sensor.stated).items() if value is not None}
    if sensor.intrinsics is not None:
        entry["intrinsics"] = _intrinsics(sensor.intrinsics)
    if sensor.clock_offset is not None:
        entry["clock_offset"] = sensor.clock_offset
    if sensor.clock_offset_stddev is not None:
        entry["clock_offset_stddev"] = sensor.clock_offset_stddev
    return entry


def _intrinsics(intrinsics: Intrinsics) -> dict[str, Any]:
    """The block as rig.yaml has it."""
    K, distortion = _round_digits(intrinsics.K, 12), _round_digits(intrinsics.distortion, 12)
    values = {"K": flow_sequence(K), "distortion": flow_sequence(distortion)}
    return {**intrinsics.model_dump(exclude_none=True), **values}


def _estimated_parameter(one: EstimatedParameter) -> dict[str, Any]:
    unit = {"unit": one.unit} if one.unit else {}
    stated, prior, value, stddev = _round_digits([one.stated, one.prior, one.value, one.stddev], 9)
    numbers = {"stated": stated, "prior": prior, "value": value, "stddev": stddev}
    return {"of": one.of, "quantity": one.quantity, **unit, **numbers}


def _correction(one: Correction) -> dict[str, Any]:
    rings = [flow_sequence(_round_digits(ring, 9)) for ring in one.rings]
    return {
        "distance": _round_digits([one.distance], 9)[0],
        "parameters": flow_sequence(parameter.quantity for parameter in one.parameters),
        **({"rings": rings} if rings else {}),
        "covariance": _symmetric(one.covariance, 9),
    }


def _provenance(provenance: Provenance) -> dict[str, Any]:
    return {name: value for name, value in asdict(provenance).items() if value is not None} | {
        "inputs": [asdict(one) for one in provenance.inputs]
    }


def _quality(calibration: Calibration) -> dict[str, Any]:
    return {
        "estimator": calibration.evidence.estimator,
        **({"tolerance": tolerance.model_dump()} if (tolerance := calibration.evidence.tolerance) else {}),
        **({"bodies": asdict(bodies)} if (bodies := calibration.evidence.bodies) else {}),
        "verdicts": {s.name: _verdict(s.verdict) for s in calibration.sensors},
        "unconnected": dict(calibration.evidence.unconnected),
        **({"remarks": list(calibration.evidence.remarks)} if calibration.evidence.remarks else {}),
        "residual_rms": {
            kind: _round_digits([value], 4)[0] for kind, value in calibration.evidence.residual_rms.items()
        },
        **({"fit": _fit(calibration.evidence.fit)} if calibration.evidence.fit else {}),
        "cross_validation": {
            name: _held_out_error(one) for name, one in calibration.evidence.cross_validation.items()
        },
        "suggestions": [_suggestion(one) for one in calibration.evidence.suggestions],
        "remedies": [_remedy(one) for one in calibration.evidence.remedies],
        "captures": _captures(calibration.evidence.captures),
    }


def _fit(fit: Mapping[str, FitError]) -> dict[str, Any]:
    return {
        name: {"measurements": one.count, "unit": one.unit, "rms": _round_digits([one.rms], 4)[0]}
        for name, one in fit.items()
    }


def _held_out_error(one: HeldOutError) -> dict[str, Any]:
    numbers = {"rms": one.rms, "median": one.median, "along": one.along, "tilt": one.tilt, "ratio": one.ratio}
    finite = {key: _round_digits([value], 4)[0] for key, value in numbers.items() if value is not None}
    return {"captures": one.captures, "unit": one.unit, **finite}


def _suggestion(one: Suggestion) -> dict[str, Any]:
    return {"hold": one.hold, **_prediction(one), **_board_pose(one.T_root_board)}


def _remedy(one: Remedy) -> dict[str, Any]:
    return {
        "action": one.action,
        **_prediction(one),
        "suffices": one.suffices,
        **({"captures": one.captures} if one.captures else {}),
        **({"duration": one.duration} if one.duration else {}),
        **({"uncertainty": _rounded(one.uncertainty)} if one.uncertainty else {}),
        **({} if one.T_root_board is None else _board_pose(one.T_root_board)),
    }


def _prediction(one: Suggestion | Remedy) -> dict[str, Any]:
    stddev, expected = _round_digits([one.stddev, one.expected], 4)
    return {"sensor": one.sensor, "axis": one.axis, "unit": one.unit, "stddev": stddev, "expected": expected}


def _rounded(uncertainty: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    return {
        of: {key: _round_digits([value], 4)[0] for key, value in known.items()}
        for of, known in uncertainty.items()
    }


def _board_pose(T_root_board: Array) -> dict[str, Any]:
    return {
        "translation": flow_sequence(_round_digits(T_root_board[:3, 3], 6)),
        "rotation": flow_sequence(_round_digits(so3.quaternion(T_root_board[:3, :3]), 6)),
    }


def _verdict(verdict: Verdict) -> dict[str, str]:
    reason = {"reason": verdict.reason} if verdict.reason else {}
    return {"grade": verdict.grade, **reason}


def _edges(edges: Sequence[Edge]) -> str:
    """The end of ``quality``: written directly, as a YAML library takes half a minute for thousands of pairs."""
    return "  edges:\n" + "".join(f"  - {{{_edge(edge)}}}\n" for edge in edges) if edges else "  edges: []\n"


def _edge(edge: Edge) -> str:
    entry = {
        "sensors": f"[{_quote(edge.sensor_a)}, {_quote(edge.sensor_b)}]",
        "captures": str(edge.captures),
        "inliers": str(edge.inliers),
        "in_tree": str(edge.in_tree).lower(),
    }
    if edge.residual_rms is not None:
        entry["residual_rms"] = format_yaml_number(_round_digits([edge.residual_rms], 4)[0])
    if edge.note:
        entry["note"] = _quote(edge.note)
    return ", ".join(f"{key}: {value}" for key, value in entry.items())


def _quote(text: str) -> str:
    """A text as JSON has it, which is YAML, too."""
    return json.dumps(text, ensure_ascii=False)


def _captures(rows: Sequence[CaptureRow]) -> dict[str, Any]:
    """When each capture was, and by sensor which were used and which rejected, by reason."""
    windows = {row.capture: (row.start, row.end) for row in reversed(rows)}
    by_sensor: dict[str, list[CaptureRow]] = {}
    for row in rows:
        by_sensor.setdefault(row.sensor, []).append(row)
    return {
        "windows": {n: flow_sequence(round(float(t), 6) for t in windows[n]) for n in sorted(windows)},
        "sensors": {name: _used_and_rejected(part) for name, part in by_sensor.items()},
    }


def _used_and_rejected(rows: Iterable[CaptureRow]) -> dict[str, Any]:
    used: list[int] = []
    rejected: dict[str, list[int]] = {}
    for row in rows:
        (used if row.used else rejected.setdefault(row.reason, [])).append(row.capture)
    return {"used": flow_sequence(used), "rejected": {why: flow_sequence(n) for why, n in rejected.items()}}


def _symmetric(covariance: Array, digits: int) -> list[CommentedSeq]:
    rows = (_round_digits(row, digits) for row in 0.5 * (covariance + covariance.T))
    return [flow_sequence(None if np.isnan(value) else value for value in row) for row in rows]


def _cross_covariances(calibration: Calibration) -> str:
    """Of all pairs whose correlation is known, written directly as :func:`_matrix` does."""
    pairs = calibration.correlated_pairs
    if not len(pairs):
        return ""
    # Names of sensors are plain in YAML, but for those that JSON's quotes make so.
    names = [json.dumps(sensor.name) for sensor in calibration.sensors]
    return "cross_covariances:\n" + "".join(
        f"- sensors: [{names[a]}, {names[b]}]\n  covariance:\n{_rows(calibration.cross_covariance(a, b))}"
        for a, b in pairs.tolist()
    )


def budget_deviations(budget: ErrorBudget, calibration: Calibration) -> Iterator[dict[str, Array]]:
    """For each source of a calibration's budget, by sensor but the root: (6,), NaN for what was not measured."""
    unmeasured = np.isnan(np.diag(calibration.joint_covariance)).reshape(-1, 6)
    names = [sensor.name for sensor in calibration.sensors]
    for stddev in np.where(unmeasured, np.nan, budget.stddev):
        yield dict(zip(names[1:], stddev[1:], strict=True))


# Variances of the sources then add up to those of the poses to 1e-4 or better.
_BUDGET_DIGITS = 5


def _budget(budget: ErrorBudget, calibration: Calibration) -> str:
    """A line for each source; written directly, as :func:`_matrix` does."""
    lines = ["budget:\n"]
    for source, deviations in zip(budget.sources, budget_deviations(budget, calibration), strict=True):
        of = f", of: {_quote(source.of)}" if source.of else ""
        stddev = ", ".join(
            f"{_quote(name)}: [{_numbers(six, _BUDGET_DIGITS)}]" for name, six in deviations.items()
        )
        lines.append(f"- {{source: {_quote(source.kind)}{of}, stddev: {{{stddev}}}}}\n")
    return "".join(lines)


def _matrix(joint_covariance: Array) -> str:
    """The rest of the file: written directly, as a YAML library takes a minute for 100,000 numbers."""
    return "  matrix:\n" + _rows(0.5 * (joint_covariance + joint_covariance.T))


def _rows(matrix: Array) -> str:
    # Relative poses may be far more certain than those in the root frame: more digits for the difference.
    return "".join(f"  - [{_numbers(row, 14)}]\n" for row in matrix)


def _numbers(values: Array, digits: int) -> str:
    rounded = _round_digits(values, digits)
    return ", ".join("null" if np.isnan(value) else format_yaml_number(value) for value in rounded)


def _round_digits(values: Iterable[float] | Array, digits: int) -> list[float]:
    """The values rounded to a number of significant digits."""
    return [float(f"{value:.{digits}g}") + 0.0 for value in np.asarray(values, dtype=np.float64)]
