"""The verdicts at the top of the page: reliability of each sensor's pose, and advice."""

from collections.abc import Mapping, Sequence

from calgraph.config import Tolerance
from calgraph.report.formatting import escape_html, format_angle, format_count, format_length
from calgraph.report.vocabulary import Vocabulary
from calgraph.result import Calibration, SensorPose
from calgraph.result.reasons import share_clauses
from calgraph.sensors.kinds import KINDS

_BADGES = {
    "good": ("good", "✓", "good"),
    "weak": ("weak", "!", "weak"),
    "unobservable": ("lost", "✕", "unobservable"),
    "unconnected": ("lost", "✕", "not calibrated"),
}
"""CSS class, sign and word for each grade: colour is never the only indication."""


# More sensors than this are counted, not listed, in the first lines.
_MAX_NAMES = 8


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
    parts = [(weak, "weak"), (lost, "unobservable"), (unconnected, "not calibrated")]
    outcomes = ", ".join(f"{count} {words}" for count, words in parts if count)
    if total == 1:
        return f"The sensor is {next(words for count, words in parts if count)}."
    well = f"{good_count} of {format_count(total, 'sensor')}" if good_count else "No sensor"
    return f"{well} {'is' if good_count < 2 else 'are'} calibrated well: {outcomes}."


def describe_good(tolerance: Tolerance, confidence: float) -> str:
    """What the verdict good means."""
    return (
        f"Good: with a probability of {100 * confidence:g} %, the error of the pose along and about each axis is "
        f"within the tolerance of {1000 * tolerance.translation:g} mm and {tolerance.rotation:g}°, and no test "
        "contradicts it. σ: one standard deviation, along and about the worst axis of the sensor."
    )


def describe_next_step(calibration: Calibration) -> str:
    """Which poses can be used, and what to do about the others, as HTML."""
    grades: dict[str, str] = {s.name: s.verdict.grade for s in calibration.sensors if s.parent is not None}
    grades |= dict.fromkeys(calibration.evidence.unconnected, "unconnected")
    if not grades:
        return ""
    usable = [name for name, grade in grades.items() if grade == "good"]
    others = [name for name, grade in grades.items() if grade != "good"]
    if not others:
        remarks = " Read the remarks below first." if calibration.evidence.remarks else ""
        export = "Next: <code>calgraph export</code> writes them as URDF, tf, Kalibr, …"
        return f"All poses can be used.{remarks} {export}"
    use = f"Only {_list_names(usable)} can be used." if usable else "No pose can be used yet."
    which = "Its card states" if len(others) == 1 else "Their cards state"
    if len(others) == 1 and others[0] in calibration.evidence.unconnected:
        what = f"{_list_names(others)} has no pose."
    elif all(name in calibration.evidence.unconnected for name in others):
        what = f"{_list_names(others)} have no poses."
    else:
        what = f"Do not rely on {_list_names(others)}."
    return f"{what} {which} why, and what to do next. {use}"


def _list_names(names: Sequence[str]) -> str:
    if len(names) > _MAX_NAMES:
        return f"<b>{len(names)} sensors</b>"
    return ", ".join(f"<b>{escape_html(name)}</b>" for name in names)


def render_cards(calibration: Calibration, words: Vocabulary) -> str:
    """A card for each sensor, those that need attention first; one for all without a pose for the same reason."""
    order = {"unobservable": 0, "weak": 1, "good": 2}
    sensors = sorted(
        (sensor for sensor in calibration.sensors if sensor.parent is not None),
        key=lambda sensor: order[sensor.verdict.grade],
    )
    advice = words.advice
    unconnected = {", ".join(names): why for why, names in calibration.evidence.unconnected_by_reason.items()}
    reasons, shared = share_clauses(unconnected | {s.name: s.verdict.reason for s in sensors if s.verdict.reason})
    shown = [
        *(_render_card("unconnected", names, {}, _explain_unconnected(reasons[names], why, advice))
          for names, why in unconnected.items()),
        *(_render_card(
            s.verdict.grade, s.name, _describe_evidence(calibration, s, words),
            reasons.get(s.name) or advice.get(s.verdict.grade, ""), KINDS[s.kind].title)
          for s in sensors),
    ]  # fmt: skip
    notes = _render_list(
        "Shared reasons", [f"{mark} {text[:1].upper()}{text[1:]}" for mark, text in shared.items()]
    )
    return f'{notes}<div class="cards">{"".join(shown)}</div>'


def render_remarks(calibration: Calibration) -> str:
    """Remarks on the whole result, but for those that are on cards; empty if there are none."""
    return _render_list("Remarks", calibration.further_remarks)


def _render_list(title: str, texts: Sequence[str]) -> str:
    """A box with a list; empty if there are none."""
    items = "".join(f"<li>{escape_html(text)}</li>" for text in texts)
    return f'<div class="next"><h3>{title}</h3><ul>{items}</ul></div>' if items else ""


def render_badge(grade: str) -> str:
    """A grade as a coloured word with a sign."""
    css, sign, word = _BADGES[grade]
    return f'<span class="badge {css}"><span aria-hidden="true">{sign}</span> {word}</span>'


def _describe_evidence(calibration: Calibration, sensor: SensorPose, words: Vocabulary) -> dict[str, str]:
    """By name: uncertainty of a sensor's pose, its residuals, those on held-out captures, and captures used."""
    evidence = calibration.evidence
    sigma_t, sigma_r = sensor.worst_stddev
    facts = {"σ of the pose": f"{format_length(sigma_t)}, {format_angle(sigma_r)}"}
    fit, held_out = evidence.fit.get(sensor.name), evidence.cross_validation.get(sensor.name)
    name = words.fit.get(sensor.kind, "residual")
    if fit:
        facts[name] = f"{fit.formatted} RMS"
    if held_out:
        facts[f"{name}, held out" if not fit else "on held-out captures"] = f"{held_out.formatted[0]} RMS"
    rows = [row for row in evidence.captures if row.sensor == sensor.name]
    if rows:
        facts[f"{words.item}s used"] = f"{sum(row.used for row in rows)} of {len(rows)}"
    if fit:
        facts["corners used" if fit.unit == "px" else "beams used"] = str(fit.count)
    return facts


def _explain_unconnected(stated: str, reason: str, advice: Mapping[str, str]) -> str:
    """Why a sensor has no pose, as its card states it, and by the whole reason what to do."""
    if not reason:
        return advice["unconnected"]
    if "the root " in reason:
        next_step = advice["root"]
    else:
        # Reasons of sensors with detections name what is missing with the others.
        next_step = advice["unconnected" if ", but " in reason else "undetected"]
    return f"{stated}. {next_step}"


def _render_card(grade: str, name: str, facts: Mapping[str, str], reason: str, kind: str = "") -> str:
    css, _, _ = _BADGES[grade]
    words = f'<p class="reason">{escape_html(reason[:1].upper() + reason[1:])}</p>' if reason else ""
    listed = "".join(
        f"<div><dt>{escape_html(key)}</dt><dd>{escape_html(value)}</dd></div>" for key, value in facts.items()
    )
    return (
        f'<article class="card {css}"><h3>{escape_html(name)}<small>{kind}</small></h3>{render_badge(grade)}'
        f"{words}{f'<dl>{listed}</dl>' if listed else ''}</article>"
    )
