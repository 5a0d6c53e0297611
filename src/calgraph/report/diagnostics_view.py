"""Diagnostics: cross-validation of the sensors, and the next best captures."""

from calgraph.report.formatting import escape_html, format_significant
from calgraph.result import Calibration

_CROSS_VALIDATION_CAPTION = """\
Error on held-out captures: each capture is left out of the solution once, and each sensor's detections in it
are compared with the prediction from the other sensors, as reprojection errors of corners or as distances of
points from the board. Ratio = observed / expected error (from noise and covariances); a ratio well above 1
indicates a model error of that sensor."""
_SUGGESTIONS_CAPTION = """\
Additional captures that reduce the uncertainty of the least certain sensor most; each assumes the ones before
it."""


def render_cross_validation(calibration: Calibration) -> str:
    """Cross-validation by sensor; empty if there was none."""
    if not calibration.evidence.cross_validation:
        return ""
    heads = ("sensor", "captures", "RMS", "median", "along the beam", "tilt", "ratio")
    head = "".join(f"<th>{name}</th>" for name in heads)
    rows = "".join(
        f"<tr><th scope='row'>{escape_html(name)}</th><td>{one.views}</td>"
        f"{''.join(f'<td>{escape_html(text)}</td>' for text in one.formatted)}"
        f"<td>{format_significant(one.ratio)}</td></tr>"
        for name, one in calibration.evidence.cross_validation.items()
    )
    return (
        f"<h3>Cross-validation</h3><p>{_CROSS_VALIDATION_CAPTION}</p>"
        f'<div class="wide"><table class="poses"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
    )


def render_suggestions(calibration: Calibration) -> str:
    """The next best captures in order; collapsed where all sensors are good, empty where there are none."""
    if not calibration.evidence.suggestions:
        return ""
    items = "".join(f"<li>{escape_html(one)}</li>" for one in calibration.evidence.suggestions)
    content = f"<p>{_SUGGESTIONS_CAPTION}</p><ol>{items}</ol>"
    if (
        all(sensor.verdict.grade == "good" for sensor in calibration.sensors)
        and not calibration.evidence.unconnected
    ):
        return f"<details><summary>Captures that would improve the result further</summary>{content}</details>"
    return f'<div class="next"><h3>Next captures</h3>{content}</div>'
