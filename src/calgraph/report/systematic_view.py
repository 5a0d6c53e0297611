"""Systematic parameters: stated value, prior and estimate of each."""

from collections.abc import Sequence

import numpy as np

from calgraph.config import Intrinsics
from calgraph.report.formatting import escape_html
from calgraph.result import Calibration, EstimatedParameter

# Deviation beyond which a parameter is listed first, prior standard deviations.
_NOTABLE = 1.0
# Deviation at the ends of the axis, prior standard deviations: more is drawn at the end.
_END = 4.0
_WIDTH, _HEIGHT = 132.0, 16.0


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
        return _WIDTH / 2 * (1 + min(max(deviation / _END, -1.0), 1.0))

    spread = one.stddev / one.prior
    middle = _HEIGHT / 2
    low, center, high = (place(one.deviation + k * spread) for k in (-1, 0, 1))
    return (
        f'<svg class="against" width="{_WIDTH:g}" height="{_HEIGHT:g}" role="img" '
        f'aria-label="{one.deviation:+.1f} ± {spread:.1f} prior standard deviations">'
        f'<rect x="{place(-1):.1f}" y="0" width="{place(1) - place(-1):.1f}" height="{_HEIGHT:g}"/>'
        f'<line class="axis" x1="{place(0):.1f}" x2="{place(0):.1f}" y1="0" y2="{_HEIGHT:g}"/>'
        f'<line x1="{low:.1f}" x2="{high:.1f}" y1="{middle:g}" y2="{middle:g}"/>'
        f'<circle cx="{center:.1f}" cy="{middle:g}" r="3"/></svg>'
    )
