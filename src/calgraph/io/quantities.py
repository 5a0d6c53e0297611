"""Quantities in rig.yaml: numbers in SI units (``0.02``) or with a unit (``2 cm``, ``1 %``), within limits."""

import re
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, Strict

from calgraph.io.strict_model import invalid, limit_to

_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\d\s.]\S*)\s*")

_RATIOS = {"%": 1e-2, "ppm": 1e-6}
_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_PIXELS = {"px": 1.0}
_TIMES = {"s": 1.0, "ms": 1e-3}
_DEGREES = {"deg": 1.0, "°": 1.0, "mrad": float(np.degrees(1e-3)), "rad": float(np.degrees(1.0))}


def _parse_with(units: Mapping[str, float]) -> BeforeValidator:
    """A validator that converts texts such as ``2 cm``; ``units`` has the factor of each unit."""

    def parse(value: Any) -> Any:
        if not isinstance(value, str):
            return value
        match = _QUANTITY.fullmatch(value)
        if match is None or match[2] not in units:
            raise invalid("", f"must be a number, or a number with a unit ({', '.join(units)}), got {value!r}")
        return float(match[1]) * units[match[2]]

    return BeforeValidator(parse)


# A relative error or a length of 1 or more is a missing unit, such as 1 for 1 %, or 20 for 20 mm.
_BOUNDED = Field(ge=0, lt=1, allow_inf_nan=False)
Ratio = Annotated[float, Strict(), _BOUNDED, _parse_with(_RATIOS)]
LengthStddev = Annotated[float, Strict(), _BOUNDED, _parse_with(_LENGTHS)]
PixelStddev = Annotated[float, Strict(), Field(ge=0, allow_inf_nan=False), _parse_with(_PIXELS)]
TimeStddev = Annotated[float, Strict(), _BOUNDED, _parse_with(_TIMES)]
_POSITIVE = Field(gt=0, allow_inf_nan=False)
LengthLimit = Annotated[float, Strict(), _POSITIVE, limit_to(1, "m"), _parse_with(_LENGTHS)]
DegreeStddev = Annotated[float, Strict(), Field(ge=0, lt=45, allow_inf_nan=False), _parse_with(_DEGREES)]
DegreeLimit = Annotated[float, Strict(), _POSITIVE, limit_to(45, "degrees"), _parse_with(_DEGREES)]
Metres = Annotated[float, Strict(), Field(allow_inf_nan=False), _parse_with(_LENGTHS)]
Tilt = Annotated[float, Strict(), Field(gt=-45, lt=45, allow_inf_nan=False), _parse_with(_DEGREES)]
# More noise than this makes a sensor useless, and is a number in another unit.
MAX_PIXELS = 20
PixelSigma = Annotated[float, Strict(), _POSITIVE, limit_to(MAX_PIXELS, "pixels")]
RangeSigma = Annotated[float, Strict(), _POSITIVE, limit_to(1, "m")]
AngleSigma = Annotated[float, Strict(), _POSITIVE, limit_to(0.2, "rad")]
