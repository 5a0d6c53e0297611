"""Systematic parameters, with their priors and estimates."""

from typing import Any

import numpy as np
from markupsafe import Markup

from calgraph.config import Intrinsics
from calgraph.report.templates import render
from calgraph.result import Calibration

# Deviation beyond which a parameter is listed first, prior standard deviations.
_NOTABLE = 1.0


def render_systematic_parameters(calibration: Calibration) -> Markup:
    """A section with all systematic parameters; empty if there are none."""
    return render(
        "systematic.html",
        notable=[one for one in calibration.systematic if abs(one.deviation) > _NOTABLE],
        rest=[one for one in calibration.systematic if abs(one.deviation) <= _NOTABLE],
        lenses=[
            _describe_lens(calibration, sensor.name, sensor.intrinsics)
            for sensor in calibration.sensors
            if sensor.intrinsics is not None
        ],
    )


def _describe_lens(calibration: Calibration, name: str, intrinsics: Intrinsics) -> tuple[Any, ...]:
    """Name, intrinsics, fields of view, parameters and remarks of a lens that was estimated from the recording."""
    camera = intrinsics.to_camera()
    middle = camera.principal_point
    borders = np.array(
        [[0, middle[1]], [camera.width - 1, middle[1]], [middle[0], 0], [middle[0], camera.height - 1]]
    )
    angles = np.degrees(np.arccos(np.clip(camera.rays(borders)[:, 2], -1, 1)))
    fields = [f"{angle:.0f}°" if np.isfinite(angle) else "unknown" for angle in angles.reshape(2, 2).sum(axis=1)]
    parameters = [one for one in calibration.systematic if one.of == name]
    remarks = [
        one for one in calibration.evidence.remarks if one.startswith(f"the intrinsics of {name} are not well")
    ]
    return name, intrinsics, fields, parameters, remarks
