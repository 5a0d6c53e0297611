"""What is beyond the poses: how well sensors predict each other, and which captures would help."""

from calgraph.report.formatting import digits, escaped
from calgraph.result import Calibration

_ABOUT_LEFT_OUT = """Every capture was left out of the solution once, and what each sensor saw in it compared
with what the others predict: corners in the image, or ends of beams and the board's plane. The ratio is that of
these errors to what noise and covariances let expect; well above 1, the sensor or its model is not as assumed."""
_ABOUT_SUGGESTIONS = """Captures that would help the least certain sensor most, beside those that there are; each
counts on those before it."""


def left_out_table(calibration: Calibration) -> str:
    """Cross-validation by sensor; nothing where there was none."""
    if not calibration.evidence.cross_validation:
        return ""
    heads = ("sensor", "captures", "RMS", "median", "along the beam", "tilt", "ratio")
    head = "".join(f"<th>{name}</th>" for name in heads)
    rows = "".join(
        f"<tr><th scope='row'>{escaped(name)}</th><td>{one.views}</td>"
        f"{''.join(f'<td>{escaped(text)}</td>' for text in one.formatted)}<td>{digits(one.ratio)}</td></tr>"
        for name, one in calibration.evidence.cross_validation.items()
    )
    return (
        f"<h3>Captures left out</h3><p>{_ABOUT_LEFT_OUT}</p>"
        f'<div class="wide"><table class="poses"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
    )


def suggestion_list(calibration: Calibration) -> str:
    """Further captures, the first one first; folded away where all is good, nothing where none would help."""
    if not calibration.evidence.suggestions:
        return ""
    items = "".join(f"<li>{escaped(one)}</li>" for one in calibration.evidence.suggestions)
    said = f"<p>{_ABOUT_SUGGESTIONS}</p><ol>{items}</ol>"
    if (
        all(sensor.verdict.grade == "good" for sensor in calibration.sensors)
        and not calibration.evidence.unconnected
    ):
        return f"<details><summary>Captures that would make it better still</summary>{said}</details>"
    return f'<div class="next"><h3>Next captures</h3>{said}</div>'
