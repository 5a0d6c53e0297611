"""Diagnostics: cross-validation of the sensors, the next best captures, and systematic parameters."""

from collections.abc import Sequence

import numpy as np

from calgraph.config import Intrinsics
from calgraph.report.formatting import escape_html, format_significant
from calgraph.result import Calibration, EstimatedParameter

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
    heads = (
        "sensor",
        "captures predicted",
        "fitted, RMS",
        "held out, RMS",
        "",
        "median",
        "along the beam",
        "tilt",
        "ratio",
    )
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


# Deviation beyond which a parameter is listed first, prior standard deviations.
_NOTABLE = 1.0
# Deviation at the ends of the axis, prior standard deviations: more is drawn at the end.
_END = 4.0
_AXIS_WIDTH, _HEIGHT = 132.0, 16.0


def render_systematic_parameters(calibration: Calibration) -> str:
    """A section with all systematic parameters, their priors and estimates; empty if there are none."""
    if not calibration.systematic:
        return ""
    lenses = "".join(
        _render_lens(calibration, sensor.name, sensor.intrinsics)
        for sensor in calibration.sensors
        if sensor.intrinsics is not None
    )
    notable = [one for one in calibration.systematic if abs(one.deviation) > _NOTABLE]
    rest = [one for one in calibration.systematic if abs(one.deviation) <= _NOTABLE]
    which = f"more than {_NOTABLE:g} prior σ off its stated value"
    first = _render_table(notable) if notable else f"<p>No parameter is {which}.</p>"
    others = (
        f"<details><summary>{len(rest)} parameters within {_NOTABLE:g} prior σ of their stated values</summary>"
        f"{_render_table(rest)}</details>"
        if rest
        else ""
    )
    return (
        '<section id="systematic"><h2>Systematic parameters</h2>'
        "<p>Errors of sensors and target that are estimated jointly with the poses, from the data and from the "
        "priors of <code>uncertainty</code> in rig.yaml. On the right, in prior standard deviations: the shaded "
        f"band is the prior (±1 σ), the bar the estimate (±1 σ); the axis ends at ±{_END:g}. "
        "Coefficients of a distortion are correlated: single ones may be far off where their joint effect in the "
        "image, which is tested, is small.</p>"
        f"{first}{others}{lenses}</section>"
    )


def _render_lens(calibration: Calibration, name: str, intrinsics: Intrinsics) -> str:
    """Intrinsics that were estimated from the recording, with standard deviations, and what limits them."""
    camera = intrinsics.to_camera()
    middle = camera.principal_point
    borders = np.array(
        [[0, middle[1]], [camera.width - 1, middle[1]], [middle[0], 0], [middle[0], camera.height - 1]]
    )
    angles = np.degrees(np.arccos(np.clip(camera.rays(borders)[:, 2], -1, 1)))
    fields = [f"{angle:.0f}°" if np.isfinite(angle) else "unknown" for angle in angles.reshape(2, 2).sum(axis=1)]
    values = [one for one in calibration.systematic if one.of == name]
    rows = "".join(
        f"<tr><th scope='row'>{escape_html(one.quantity)}</th>"
        + "".join(f"<td>{escape_html(text)}</td>" for text in one.formatted[2:])
        + "</tr>"
        for one in values
    )
    remarks = [
        one for one in calibration.evidence.remarks if one.startswith(f"the intrinsics of {name} are not well")
    ]
    limits = "".join(f"<li>{escape_html(one)}</li>" for one in remarks)
    error = f"{intrinsics.model_error:.2g} px" if intrinsics.model_error else "none was found"
    return (
        f"<h3>Intrinsics of {escape_html(name)}</h3>"
        f"<p>Estimated from {intrinsics.estimated_from_views} views of this recording: {intrinsics.model}, "
        f"{intrinsics.width} x {intrinsics.height} pixels, a field of view of {fields[0]} by {fields[1]}. "
        f"Error of the lens's model (RMS): {error}; standard deviations contain it.</p>"
        f'<div class="wide"><table class="poses"><thead><tr><th>parameter</th><th>estimate</th><th>σ</th>'
        f"<th>unit</th></tr></thead><tbody>{rows}</tbody></table></div>" + (f"<ul>{limits}</ul>" if limits else "")
    )


def _render_table(parameters: Sequence[EstimatedParameter]) -> str:
    names = ("of", "quantity", "stated", "prior σ", "estimate", "σ", "unit", "deviation", "against the prior")
    head = "".join(f"<th>{name}</th>" for name in names)
    rows = "".join(
        f"<tr><th scope='row'>{escape_html(one.of)}</th><td>{escape_html(one.quantity)}</td>"
        f"{''.join(f'<td>{escape_html(text)}</td>' for text in one.formatted)}"
        f"<td>{one.deviation:+.1f} prior σ</td><td>{_draw(one)}</td></tr>"
        for one in parameters
    )
    return (
        f'<div class="wide"><table class="poses"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
    )


def _draw(one: EstimatedParameter) -> str:
    """The estimate with its standard deviation on an axis in prior standard deviations, as SVG."""

    def place(deviation: float) -> float:
        return _AXIS_WIDTH / 2 * (1 + min(max(deviation / _END, -1.0), 1.0))

    spread = one.stddev / one.prior
    middle = _HEIGHT / 2
    low, center, high = (place(one.deviation + k * spread) for k in (-1, 0, 1))
    return (
        f'<svg class="against" width="{_AXIS_WIDTH:g}" height="{_HEIGHT:g}" role="img" '
        f'aria-label="{one.deviation:+.1f} ± {spread:.1f} prior standard deviations">'
        f'<rect x="{place(-1):.1f}" y="0" width="{place(1) - place(-1):.1f}" height="{_HEIGHT:g}"/>'
        f'<line class="axis" x1="{place(0):.1f}" x2="{place(0):.1f}" y1="0" y2="{_HEIGHT:g}"/>'
        f'<line x1="{low:.1f}" x2="{high:.1f}" y1="{middle:g}" y2="{middle:g}"/>'
        f'<circle cx="{center:.1f}" cy="{middle:g}" r="3"/></svg>'
    )
