"""Prior standard deviations of systematic errors of sensors and boards, and the tolerance of the result.

In rig.yaml a quantity is a number in SI units (``0.02``) or a number with a unit (``2 cm``, ``1 %``).
"""

import re
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, Strict

from calgraph.config.strict_model import StrictModel, invalid, limit_to
from calgraph.geometry import Array

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


class _TimeUncertainty(StrictModel):
    """What all sensors share."""

    stamp_delay: TimeStddev = 0.02
    """Seconds, by which it measures later than its stamps, relative to the root; only where the board moves.
    Drivers stamp images when exposures begin or when they arrive, 5 to 30 ms off."""


class CameraUncertainty(_TimeUncertainty):
    """Prior standard deviations of a camera's intrinsics and times; 0 means exact."""

    focal_length: Ratio = 0.01
    """Relative, common to fx and fy. Calibrations from few, little tilted boards are wrong by up to 1 %;
    refocusing and temperature change it by some 0.1 %."""
    pixel_aspect: Ratio = 0.001
    """Relative, of fx / fy. Pixels are square by lithography to far better than this; stated intrinsics differ
    from it by their estimation only."""
    principal_point: PixelStddev = 10.0
    """Pixels, per axis. Independent calibrations of one camera differ by some px, and a lens moves in its
    mount by 0.03 mm, 10 pixels of 3 µm, when it is refocused or bumped."""
    distortion: PixelStddev = 6.0
    """Pixels at the corner of the image, each coefficient. Boards rarely cover the corners in calibration, so
    that models extrapolate there. On a real recording, priors of 6 px gave poses of disjoint sets of captures
    that differ as stated, together with the other defaults here."""
    readout_time: TimeStddev = 0.02
    """Seconds, from the first to the last row of an image; only where the board moves. Rolling shutters take 10 to
    33 ms; state 0 for a global shutter."""


class _RangeUncertainty(_TimeUncertainty):
    """What scanners with one and with several beams share."""

    range_bias: LengthStddev = 0.02
    """m, the same for all beams. Data sheets state ±30 mm (Velodyne VLP-16, SICK LMS1xx, Hokuyo UTM-30LX up to
    10 m) to ±60 mm (SICK TiM), as limits: one and a half to three of these standard deviations."""
    range_scale: Ratio = 0.003
    """Relative. Clocks of scanners are better, but a linearity error of ±30 mm over 10 m has this slope.
    Triangulating and cheap phase-shift scanners need 1 %: Hokuyo URG-04LX and RPLIDAR A1 state 1 % of the
    range."""


class Lidar2dUncertainty(_RangeUncertainty):
    """Prior standard deviations of a 2-D scanner's systematic errors; 0 means exact."""

    angle_scale: Ratio = 0.002
    """Relative, of the stated angle increment. Drivers that divide the field of view by the number of beams,
    not by that of increments, are off by 0.1 % (1081 beams) to 0.3 % (361 beams)."""
    tilt: DegreeStddev = 2.0
    """Degrees, of the scan plane about each horizontal axis; only in networks, where it makes ranges longer than
    horizontal distances, by 0.06 % at 2° across the axis. Brackets are levelled by eye or with a spirit level."""
    clock_drift: Ratio = 3e-5
    """Relative error of the clock's rate; only in networks, beside the clock offset. Quartz oscillators of
    computers and scanners are specified to ±50 ppm over temperature: 3 ms in a minute."""


class Lidar3dUncertainty(_RangeUncertainty):
    """Prior standard deviations of a 3-D LiDAR's systematic errors; 0 means exact."""

    ring_bias: LengthStddev = 0.01
    """m, of each ring beside the common range bias. In a real VLP-16, four of 16 rings were off by -14 to +19
    mm and the others by less."""


class BoardUncertainty(StrictModel):
    """Prior standard deviations of a board's geometry; 0 means exact."""

    print_scale: Ratio = 0.005
    """Relative, of the whole print. Laser printers are off by 0.2 to 1 %, and paper grows by some 0.1 % with
    humidity."""
    print_aspect: Ratio = 0.003
    """Relative, of the print's width over its height. Printers feed paper with another error than they scan
    with: two real boards measured 0.4 % and 0.7 %."""
    tag_size: Ratio = 0.005
    """Relative, of all tags about their centres; only for boards with several. Each is a print, with the error of
    print_scale, and people measure the black square to 1 mm in 0.2 m."""
    tag_position: LengthStddev = 0.001
    """m, of each tag along both axes; only for boards with ``tags:``. Tags glued on separately are placed, and
    measured, to the millimetre marks of a ruler."""
    bow: LengthStddev = 0.002
    """m, of the middle of the board over its edges. Foam boards and plywood of 1 m bend by this under their
    weight and with humidity."""
    size: LengthStddev = 0.002
    """m, of the width and of the height. Cuts and tape measures are this good."""
    print_position: LengthStddev = 0.002
    """m, of the print on the board, along both axes. Prints are glued on to the cut edge no better than it is
    cut."""


class Tolerance(StrictModel):
    """The largest acceptable error of a pose along and about each axis; a good pose is within it with 95 %."""

    translation: LengthLimit = 0.01
    """m. The range noise of a good scanner: a smaller error does not show in its measurements."""
    rotation: DegreeLimit = 0.3
    """Degrees. It moves a point by 0.01 m, the tolerance of translations, at 2 m."""

    @property
    def limits(self) -> Array:
        """(6,) the tolerance along x, y, z (m) and about them (rad)."""
        return np.repeat([self.translation, np.radians(self.rotation)], 3)
