"""Writing calibration.yaml, which other programs read, and captures.csv, one row per capture and sensor."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml.comments import CommentedSeq

from calgraph.config import Intrinsics
from calgraph.geometry import Array, so3
from calgraph.io.atomic import write_text
from calgraph.io.text_writing import escape_formula, flow_sequence, format_yaml, format_yaml_number, write_csv
from calgraph.result.budget import ErrorBudget
from calgraph.result.calibration import Calibration, Provenance
from calgraph.result.correction import Correction
from calgraph.result.estimated_parameter import EstimatedParameter
from calgraph.result.evidence import CaptureRow, Edge, FitError, HeldOutError, Remedy, Suggestion
from calgraph.result.sensor_pose import BaseFrame, SensorPose, Verdict

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
        "base": calibration.base and _base(calibration.base),
        "sensors": {sensor.name: _sensor(sensor) for sensor in calibration.sensors},
        "quality": _quality(calibration),
    }
    text = format_yaml(_known(content), _HEADER) + _edges(calibration.evidence.edges)
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
    write_csv(path, _CAPTURE_COLUMNS, map(_capture_row, calibration.evidence.captures))


def _capture_row(row: CaptureRow) -> tuple[object, ...]:
    residual = "" if row.residual is None else f"{row.residual:.5f}"
    used = "yes" if row.used else "no"
    sensor, reason = escape_formula(row.sensor), escape_formula(row.reason)
    return row.capture, f"{row.start:.3f}", f"{row.end:.3f}", sensor, used, reason, residual


def _base(base: BaseFrame) -> dict[str, Any]:
    entry: dict[str, Any] = {"frame": base.frame, "axle": base.axle}
    if base.known:
        entry |= {**_pose(base.T_base_root), "covariance": _symmetric(base.covariance, 9)}
    return {**entry, "verdict": _verdict(base.verdict)}


def _sensor(sensor: SensorPose) -> dict[str, Any]:
    return _known({
        "parent": sensor.parent,
        "kind": sensor.kind,
        "frame_id": sensor.frame_id,
        **_pose(sensor.T_root_sensor),
        "covariance": _symmetric(sensor.covariance, 9),
        "stated": sensor.stated and _known(asdict(sensor.stated)),
        "intrinsics": sensor.intrinsics and _intrinsics(sensor.intrinsics),
        "clock_offset": sensor.clock_offset,
        "clock_offset_stddev": sensor.clock_offset_stddev,
    })  # fmt: skip


def _known(entries: Mapping[str, Any]) -> dict[str, Any]:
    """The entries with a value."""
    return {key: value for key, value in entries.items() if value is not None}


# Those of poses keep them to better than 1e-12 at any distance within a rig.
_POSE_DIGITS, _BOARD_DIGITS = (15, 14), (6, 6)


def _pose(T: Array, digits: tuple[int, int] = _POSE_DIGITS) -> dict[str, Any]:
    """Translation and rotation of a pose (4, 4); null for coordinates that are not known."""
    translation = _round_digits(T[:3, 3], digits[0])
    return {
        "translation": flow_sequence(None if np.isnan(x) else x for x in translation),
        "rotation": flow_sequence(_round_digits(so3.quaternion(T[:3, :3]), digits[1])),
    }


def _intrinsics(intrinsics: Intrinsics) -> dict[str, Any]:
    """The block as rig.yaml has it."""
    K, distortion = _round_digits(intrinsics.K, 12), _round_digits(intrinsics.distortion, 12)
    values = {"K": flow_sequence(K), "distortion": flow_sequence(distortion)}
    return {**intrinsics.model_dump(exclude_none=True), **values}


def _estimated_parameter(one: EstimatedParameter) -> dict[str, Any]:
    numbers = {"stated": one.stated, "prior": one.prior, "value": one.value, "stddev": one.stddev}
    return _known({"of": one.of, "quantity": one.quantity, "unit": one.unit or None, **_round_values(numbers, 9)})


def _correction(one: Correction) -> dict[str, Any]:
    rings = [flow_sequence(_round_digits(ring, 9)) for ring in one.rings]
    return _known({
        **_round_values({"distance": one.distance}, 9),
        "parameters": flow_sequence(parameter.quantity for parameter in one.parameters),
        "rings": rings or None,
        "covariance": _symmetric(one.covariance, 9),
    })  # fmt: skip


def _provenance(provenance: Provenance) -> dict[str, Any]:
    return _known(asdict(provenance)) | {"inputs": [asdict(one) for one in provenance.inputs]}


def _quality(calibration: Calibration) -> dict[str, Any]:
    evidence = calibration.evidence
    return _known({
        "estimator": evidence.estimator,
        "tolerance": evidence.tolerance and evidence.tolerance.model_dump(),
        "bodies": evidence.bodies and asdict(evidence.bodies),
        "verdicts": {s.name: _verdict(s.verdict) for s in calibration.sensors},
        "unconnected": dict(evidence.unconnected),
        "remarks": list(evidence.remarks) or None,
        "residual_rms": _round_values(evidence.residual_rms),
        "fit": {name: _fit_error(one) for name, one in evidence.fit.items()} or None,
        "cross_validation": {name: _held_out_error(one) for name, one in evidence.cross_validation.items()},
        "suggestions": [
            {"hold": one.hold, **_prediction(one), **_pose(one.T_root_board, _BOARD_DIGITS)}
            for one in evidence.suggestions
        ],
        "remedies": [_remedy(one) for one in evidence.remedies],
        "captures": _captures(evidence.captures),
    })  # fmt: skip


def _fit_error(one: FitError) -> dict[str, Any]:
    return {"measurements": one.count, "unit": one.unit, **_round_values({"rms": one.rms})}


def _held_out_error(one: HeldOutError) -> dict[str, Any]:
    numbers = {"rms": one.rms, "median": one.median, "along": one.along, "tilt": one.tilt, "ratio": one.ratio}
    return {"captures": one.captures, "unit": one.unit, **_round_values(_known(numbers))}


def _remedy(one: Remedy) -> dict[str, Any]:
    return _known({
        "action": one.action,
        **_prediction(one),
        "suffices": one.suffices,
        "captures": one.captures or None,
        "duration": one.duration or None,
        "uncertainty": {of: _round_values(known) for of, known in one.uncertainty.items()} or None,
        **({} if one.T_root_board is None else _pose(one.T_root_board, _BOARD_DIGITS)),
    })  # fmt: skip


def _prediction(one: Suggestion | Remedy) -> dict[str, Any]:
    numbers = _round_values({"stddev": one.stddev, "expected": one.expected})
    return {"sensor": one.sensor, "axis": one.axis, "unit": one.unit, **numbers}


def _verdict(verdict: Verdict) -> dict[str, Any]:
    return _known({"grade": verdict.grade, "reason": verdict.reason or None})


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


def _round_values(values: Mapping[str, float], digits: int = 4) -> dict[str, float]:
    return dict(zip(values, _round_digits(list(values.values()), digits), strict=True))
