"""The corrections of sensors' data as YAML."""

from collections.abc import Sequence
from typing import Any

from calgraph.errors import InputError
from calgraph.io.text_writing import flow_sequence, format_yaml
from calgraph.result.calibration import Calibration
from calgraph.result.correction import Correction
from calgraph.result.estimated_parameter import EstimatedParameter
from calgraph.sensors.kinds import KINDS

FORMAT = "calgraph-corrections/1"
_HEADER = """\
Corrections of data as the sensors publish them, in their frames; poses are separate. Lengths in m, angles in rad.
apply: with the values of parameters; where one is left out, with 0 for a bias and 1 for a scale. A ring has the
beams between its lowest and highest elevation; other beams have no bias of a ring.
covariance: of the parameters in their order: they belong together.
range_error: by how much ranges at distance are longer than the true ones, mean of all rings.
mostly_prior: parameters that the data hardly determined, which are not corrected."""


def to_corrections(calibration: Calibration) -> str:
    """The corrections of all sensors: parameters with their joint covariance, working distance, how to apply them.

    Raises:
        InputError: the calibration states none.
    """
    if not calibration.corrections:
        raise InputError(
            "this result states no corrections: those of rigs do, by the default estimator; calibrate again if it "
            "is of an earlier version"
        )
    sensors = {name: _describe(one, calibration[name].frame_id) for name, one in calibration.corrections.items()}
    return format_yaml({"format": FORMAT, "sensors": sensors}, _HEADER)


def _describe(one: Correction, frame_id: str) -> dict[str, Any]:
    learned, kind = one.learned(), KINDS[one.kind]
    kept = {parameter.quantity for parameter in learned.parameters}
    error, stddev = (_round(values[0]) for values in one.measure(one.range_effects()[None]))
    # Biases of rings are the last parameters.
    borders = [None] * (len(kept) - len(learned.rings)) + learned.ring_borders.tolist()
    return {
        "kind": one.kind,
        "frame_id": frame_id,
        "distance": _round(one.distance),
        **({"range_error": {"value": error, "stddev": stddev}} if kind.measures_ranges else {}),
        "apply": kind.correction,
        "parameters": [
            _describe_parameter(parameter, border)
            for parameter, border in zip(learned.parameters, borders, strict=True)
        ],
        "covariance": [flow_sequence(map(_round, row)) for row in learned.covariance],
        "mostly_prior": flow_sequence(p.quantity for p in one.parameters if p.quantity not in kept),
    }


def _describe_parameter(one: EstimatedParameter, border: Sequence[float] | None) -> dict[str, Any]:
    unit = {"unit": one.unit} if one.unit else {}
    elevations = dict(zip(("lowest_elevation", "highest_elevation"), map(_round, border or ()), strict=False))
    numbers = {name: _round(getattr(one, name)) for name in ("value", "stddev", "stated", "prior")}
    return {"quantity": one.quantity, **unit, **elevations, **numbers}


def _round(value: float) -> float:
    """A number with nine significant digits."""
    return float(f"{value:.9g}")
