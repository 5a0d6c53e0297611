"""The verdicts at the top of the page: reliability of each sensor's pose, and advice."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from calgraph.config import Rig
from calgraph.report.formatting import format_angle, format_count, format_length
from calgraph.report.pose_picture import DrawnSensor, draw_pose
from calgraph.report.templates import render
from calgraph.report.vocabulary import Vocabulary
from calgraph.result import Calibration, SensorPose
from calgraph.result.finding import share_clauses
from calgraph.sensors.kinds import KINDS

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


def describe_next_step(calibration: Calibration) -> Markup:
    """Which poses can be used, and what to do about the others."""
    grades: dict[str, str] = {s.name: s.verdict.grade for s in calibration.sensors if s.parent is not None}
    grades |= dict.fromkeys(calibration.evidence.unconnected, "unconnected")
    if not grades:
        return Markup()
    usable = [name for name, grade in grades.items() if grade == "good"]
    others = [name for name, grade in grades.items() if grade != "good"]
    if not others:
        remarks = " Read the remarks below first." if calibration.evidence.remarks else ""
        export = Markup("Next: <code>calgraph export</code> writes them as URDF, tf, Kalibr, …")
        return Markup("All poses can be used.{} {}").format(remarks, export)
    use = Markup("Only {} can be used.").format(_list_names(usable)) if usable else "No pose can be used yet."
    which = "Its card states" if len(others) == 1 else "Their cards state"
    if len(others) == 1 and others[0] in calibration.evidence.unconnected:
        what = "{} has no pose."
    elif all(name in calibration.evidence.unconnected for name in others):
        what = "{} have no poses."
    else:
        what = "Do not rely on {}."
    return Markup(what + " {} why, and what to do next. {}").format(_list_names(others), which, use)


def _list_names(names: Sequence[str]) -> Markup:
    if len(names) > _MAX_NAMES:
        return Markup("<b>{} sensors</b>").format(len(names))
    return Markup(", ").join(Markup("<b>{}</b>").format(name) for name in names)


@dataclass(frozen=True)
class _Card:
    grade: str
    name: str
    facts: Mapping[str, str]
    reason: str
    kind: str = ""


def render_cards(calibration: Calibration, rig: Rig, words: Vocabulary) -> Markup:
    """A card for each sensor, those that need attention first; one for all without a pose for the same reason.

    With the remarks on the whole result, but for those that are on cards, and the next best captures.
    """
    order = {"unobservable": 0, "weak": 1, "root": 2, "good": 3}
    grades = {s.name: s.verdict.grade if s.parent is not None else "root" for s in calibration.sensors}
    sensors = sorted(calibration.sensors, key=lambda sensor: order[grades[sensor.name]])
    advice = words.advice
    unconnected = {", ".join(names): why for why, names in calibration.evidence.unconnected_by_reason.items()}
    reasons, shared = share_clauses(
        unconnected | {s.name: s.verdict.reason for s in sensors if s.parent is not None and s.verdict.reason}
    )
    cards = [
        *(_Card("unconnected", names, {}, _explain_unconnected(reasons[names], why, advice))
          for names, why in unconnected.items()),
        *(_Card(
            grades[s.name], s.name, _describe_evidence(calibration, s, words),
            reasons.get(s.name) or advice.get(s.verdict.grade, "") * (s.parent is not None), KINDS[s.kind].title)
          for s in sensors),
    ]  # fmt: skip
    notes = [f"{mark} {text[:1].upper()}{text[1:]}" for mark, text in shared.items()]
    # The root first: its forward axis points upwards in the pictures.
    drawn = [DrawnSensor(s.name, s.kind, s.T_root_sensor) for s in calibration.sensors]
    suggestions = [
        (str(one), Markup(draw_pose(drawn, one.T_root_board, rig.board_size, one.sensor)))
        for one in calibration.evidence.suggestions
    ]
    return render("cards.html", calibration=calibration, cards=cards, shared=notes, suggestions=suggestions)


def _describe_evidence(calibration: Calibration, sensor: SensorPose, words: Vocabulary) -> dict[str, str]:
    """By name: uncertainty of a sensor's pose, its residuals, those on held-out captures, and captures used."""
    evidence = calibration.evidence
    sigma_t, sigma_r = sensor.worst_stddev
    facts = {"σ of the pose": f"{format_length(sigma_t)}, {format_angle(sigma_r)}"}
    if sensor.parent is None:
        facts = {"pose": "is the reference"}
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
    # Reasons of drives state what to drive instead.
    if ": drive " in reason or "; drive " in reason:
        return f"{stated}."
    if "the root " in reason:
        next_step = advice["root"]
    else:
        # Reasons of sensors with detections name what is missing with the others.
        next_step = advice["unconnected" if ", but " in reason else "undetected"]
    return f"{stated}. {next_step}"
