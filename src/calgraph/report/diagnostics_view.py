"""Diagnostics: cross-validation of the sensors, and the next best captures."""

from calgraph.report.formatting import escape_html, format_significant
from calgraph.result import Calibration

_CROSS_VALIDATION_CAPTION = """\
Error on held-out captures: each capture is left out of the solution once, and each sensor's detections in it
are compared with the prediction from the other sensors, as reprojection errors of corners or as distances of
points from the board. Fitted: RMS of the residuals of the joint solution, which contains the capture. A held-out
error well above it indicates that poses are adapted to the noise of few captures. Ratio = observed / expected
error on held-out captures (from noise and covariances); a ratio well above 1 indicates a model error of that
sensor."""
# Length of the longer bar, px.
_WIDTH = 90.0
_SUGGESTIONS_CAPTION = """\
Additional captures that reduce the uncertainty of the least certain sensor most; each assumes the ones before
it."""


def render_cross_validation(calibration: Calibration) -> str:
    """Cross-validation by sensor; empty if there was none."""
    if not calibration.evidence.cross_validation:
        return ""
    fit = calibration.evidence.fit
    heads = ("sensor", "captures", "fitted, RMS", "held out, RMS", "", "median", "along the beam", "tilt", "ratio")
    head = "".join(f"<th>{name}</th>" for name in heads)
    rows = "".join(
        f"<tr><th scope='row'>{escape_html(name)}</th><td>{one.captures}</td>"
        f"<td>{escape_html(fit[name].formatted) if name in fit else '–'}</td><td>{one.formatted[0]}</td>"
        f"<td>{_draw_bars(fit[name].rms, one.rms) if name in fit else ''}</td>"
        f"{''.join(f'<td>{escape_html(text)}</td>' for text in one.formatted[1:])}"
        f"<td>{format_significant(one.ratio)}</td></tr>"
        for name, one in calibration.evidence.cross_validation.items()
    )
    return (
        f"<h3>Cross-validation</h3><p>{_CROSS_VALIDATION_CAPTION}</p>"
        f'<div class="wide"><table class="poses"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
    )


def _draw_bars(fitted: float, held_out: float) -> str:
    """Both errors as bars of a common scale, as SVG."""
    longest = max(fitted, held_out, 1e-12)
    bars = "".join(
        f'<rect class="{css}" y="{9 * k}" width="{_WIDTH * value / longest:.1f}" height="7"/>'
        for k, (css, value) in enumerate((("fitted", fitted), ("held-out", held_out)))
    )
    return (
        f'<svg class="bars" width="{_WIDTH:g}" height="16" role="img" '
        f'aria-label="held-out error {held_out / max(fitted, 1e-12):.2f} times the fitted one">{bars}</svg>'
    )


def render_suggestions(calibration: Calibration) -> str:
    """The next best captures in order; collapsed where all poses are good, empty where there are none."""
    if not calibration.evidence.suggestions:
        return ""
    items = "".join(f"<li>{escape_html(one)}</li>" for one in calibration.evidence.suggestions)
    content = f"<p>{_SUGGESTIONS_CAPTION}</p><ol>{items}</ol>"
    if all(sensor.verdict.grade == "good" for sensor in calibration.sensors):
        return f"<details><summary>Captures that would improve the result further</summary>{content}</details>"
    return f'<div class="next"><h3>Next captures</h3>{content}</div>'
