"""The top of the page: how far each sensor's pose can be relied on, and what to do."""

import numpy as np

from calgraph.geometry import Array
from calgraph.report.formatting import angle, counted, escaped, kind_of, length
from calgraph.report.vocabulary import Words
from calgraph.result import Calibration, SensorPose

_BADGES = {
    "good": ("good", "✓", "good"),
    "weak": ("weak", "!", "weak"),
    "unobservable": ("lost", "✕", "unobservable"),
    "unconnected": ("lost", "✕", "not connected"),
}
"""CSS class, sign and word for each grade: colour is never the only sign."""


def headline(calibration: Calibration) -> str:
    """One sentence that says how it went."""
    grades = [s.verdict.grade for s in calibration.sensors if s.parent is not None]
    good, weak, lost = (grades.count(grade) for grade in ("good", "weak", "unobservable"))
    unconnected = len(calibration.evidence.unconnected)
    total = len(grades) + unconnected
    if total == 0:
        return "There is nothing to calibrate: the root is the only sensor."
    if good == total:
        return "Every sensor is calibrated well." if total > 1 else "The sensor is calibrated well."
    parts = [(good, "calibrated well"), (weak, "weak"), (lost, "unobservable"), (unconnected, "not connected")]
    said = ", ".join(f"{count} {words}" for count, words in parts if count)
    return f"Of {counted(total, 'sensor')} besides the root: {said}."


def cards(calibration: Calibration, words: Words) -> str:
    """A card for each sensor, those that need attention first."""
    order = {"unobservable": 0, "weak": 1, "good": 2}
    sensors = sorted(
        (sensor for sensor in calibration.sensors if sensor.parent is not None),
        key=lambda sensor: order[sensor.verdict.grade],
    )
    advice = words.advice
    lost = advice["unconnected"]
    shown = [
        *(_card("unconnected", name, "no pose", f"{why}. {lost}" if why else lost)
          for name, why in calibration.evidence.unconnected.items()),
        *(_card(s.verdict.grade, s.name, _facts(s), s.verdict.reason or advice.get(s.verdict.grade, ""))
          for s in sensors),
    ]  # fmt: skip
    return f'<div class="cards">{"".join(shown)}</div>'


def remark_list(calibration: Calibration) -> str:
    """What is to be known of the whole result; nothing where there is nothing."""
    if not calibration.evidence.remarks:
        return ""
    items = "".join(f"<li>{escaped(remark)}</li>" for remark in calibration.evidence.remarks)
    return f'<div class="next"><h3>Not used</h3><ul>{items}</ul></div>'


def badge(grade: str) -> str:
    """A grade as a coloured word with a sign."""
    css, sign, word = _BADGES[grade]
    return f'<span class="badge {css}"><span aria-hidden="true">{sign}</span> {word}</span>'


def worst_deviation(covariance: Array) -> float:
    """The standard deviation along the worst direction of a covariance (3, 3)."""
    if not np.isfinite(covariance).all():
        return float("nan") if np.isnan(covariance).any() else float("inf")
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))


def _facts(sensor: SensorPose) -> str:
    sigma_t, sigma_r = worst_deviation(sensor.covariance[:3, :3]), worst_deviation(sensor.covariance[3:, 3:])
    return f"{kind_of(sensor)} · σ {length(sigma_t)}, {angle(sigma_r)} in the worst direction"


def _card(grade: str, name: str, facts: str, reason: str) -> str:
    css, _, _ = _BADGES[grade]
    words = f'<p class="reason">{escaped(reason[:1].upper() + reason[1:])}</p>' if reason else ""
    return (
        f'<article class="card {css}"><h3>{escaped(name)}</h3>{badge(grade)}'
        f'<p class="facts">{escaped(facts)}</p>{words}</article>'
    )
