"""The verdicts at the top of the page: reliability of each sensor's pose, and advice."""

import numpy as np

from calgraph.config import Tolerance
from calgraph.geometry import Array
from calgraph.report.formatting import KIND_NAMES, escape_html, format_angle, format_count, format_length
from calgraph.report.vocabulary import Vocabulary
from calgraph.result import Calibration, SensorPose

_BADGES = {
    "good": ("good", "✓", "good"),
    "weak": ("weak", "!", "weak"),
    "unobservable": ("lost", "✕", "unobservable"),
    "unconnected": ("lost", "✕", "not connected"),
}
"""CSS class, sign and word for each grade: colour is never the only indication."""


def summarize_verdicts(calibration: Calibration) -> str:
    """One sentence on the overall result."""
    grades = [s.verdict.grade for s in calibration.sensors if s.parent is not None]
    good_count, weak, lost = (grades.count(grade) for grade in ("good", "weak", "unobservable"))
    unconnected = len(calibration.evidence.unconnected)
    total = len(grades) + unconnected
    if total == 0:
        return "There is nothing to calibrate: the root is the only sensor."
    if good_count == total:
        return "Every sensor is calibrated well." if total > 1 else "The sensor is calibrated well."
    parts = [
        (good_count, "calibrated well"),
        (weak, "weak"),
        (lost, "unobservable"),
        (unconnected, "not connected"),
    ]
    outcomes = ", ".join(f"{count} {words}" for count, words in parts if count)
    return f"Of {format_count(total, 'sensor')} besides the root: {outcomes}."


def describe_good(tolerance: Tolerance, confidence: float) -> str:
    """What the verdict good means."""
    return (
        f"Good: with a probability of {100 * confidence:g} %, the error of the pose along and about each axis is "
        f"within the tolerance of {1000 * tolerance.translation:g} mm and {tolerance.rotation:g}°, and nothing "
        "contradicts."
    )


def render_cards(calibration: Calibration, words: Vocabulary) -> str:
    """A card for each sensor, those that need attention first."""
    order = {"unobservable": 0, "weak": 1, "good": 2}
    sensors = sorted(
        (sensor for sensor in calibration.sensors if sensor.parent is not None),
        key=lambda sensor: order[sensor.verdict.grade],
    )
    advice = words.advice
    lost = advice["unconnected"]
    shown = [
        *(_render_card("unconnected", name, "no pose", f"{why}. {lost}" if why else lost)
          for name, why in calibration.evidence.unconnected.items()),
        *(_render_card(
            s.verdict.grade, s.name, _describe_evidence(calibration, s, words),
            s.verdict.reason or advice.get(s.verdict.grade, ""))
          for s in sensors),
    ]  # fmt: skip
    return f'<div class="cards">{"".join(shown)}</div>'


def render_remarks(calibration: Calibration) -> str:
    """Remarks on the whole result; empty if there are none."""
    if not calibration.evidence.remarks:
        return ""
    items = "".join(f"<li>{escape_html(remark)}</li>" for remark in calibration.evidence.remarks)
    return f'<div class="next"><h3>Remarks</h3><ul>{items}</ul></div>'


def render_badge(grade: str) -> str:
    """A grade as a coloured word with a sign."""
    css, sign, word = _BADGES[grade]
    return f'<span class="badge {css}"><span aria-hidden="true">{sign}</span> {word}</span>'


def max_std_deviation(covariance: Array) -> float:
    """The standard deviation along the worst direction of a covariance (3, 3)."""
    if not np.isfinite(covariance).all():
        return float("nan") if np.isnan(covariance).any() else float("inf")
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))


def _describe_evidence(calibration: Calibration, sensor: SensorPose, words: Vocabulary) -> str:
    """Uncertainty of a sensor's pose, the number of captures that it rests on, and its error on held-out ones."""
    rows = [row for row in calibration.evidence.captures if row.sensor == sensor.name]
    facts = [_describe_uncertainty(sensor)]
    if rows:
        facts.append(f"{sum(row.used for row in rows)} of {format_count(len(rows), words.item)} used")
    if held_out := calibration.evidence.cross_validation.get(sensor.name):
        facts.append(f"held-out error {held_out.formatted[0]} RMS")
    return " · ".join(facts)


def _describe_uncertainty(sensor: SensorPose) -> str:
    sigma_t, sigma_r = max_std_deviation(sensor.covariance[:3, :3]), max_std_deviation(sensor.covariance[3:, 3:])
    return (
        f"{KIND_NAMES[sensor.kind]} · σ {format_length(sigma_t)}, {format_angle(sigma_r)} in the worst direction"
    )


def _render_card(grade: str, name: str, facts: str, reason: str) -> str:
    css, _, _ = _BADGES[grade]
    words = f'<p class="reason">{escape_html(reason[:1].upper() + reason[1:])}</p>' if reason else ""
    return (
        f'<article class="card {css}"><h3>{escape_html(name)}</h3>{render_badge(grade)}'
        f'<p class="facts">{escape_html(facts)}</p>{words}</article>'
    )
