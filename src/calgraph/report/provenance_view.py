"""How the calibration was computed, at the end of the report."""

from datetime import UTC, datetime

from calgraph.report.formatting import escape_html
from calgraph.result import Calibration


def render_provenance(calibration: Calibration) -> str:
    """The program, the command and the input files, as HTML; nothing where they are unknown."""
    provenance = calibration.provenance
    if provenance is None:
        return ""
    rows = [
        ("calgraph", provenance.version),
        ("date", provenance.date),
        ("command", provenance.command),
        *((one.path, f"SHA-256 {one.sha256}") for one in provenance.inputs),
    ]
    if provenance.start is not None and provenance.duration is not None:
        start = datetime.fromtimestamp(provenance.start, UTC).isoformat(timespec="seconds")
        rows.append(("recording", f"{provenance.duration:.1f} s from {start}, {provenance.messages} messages"))
    if provenance.cached:
        rows.append(("from the cache", f"detections of {', '.join(provenance.cached)}"))
    cells = "".join(f"<tr><th scope=row>{escape_html(k)}</th><td>{escape_html(v)}</td></tr>" for k, v in rows)
    return f'<section id="provenance"><h2>Provenance</h2><div class="wide"><table>{cells}</table></div></section>'
