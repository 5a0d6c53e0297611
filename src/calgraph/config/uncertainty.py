"""Prior standard deviations of systematic errors of boards, and the tolerance of the result."""

import numpy as np

from calgraph.geometry import Array
from calgraph.io.quantities import DegreeLimit, LengthLimit, LengthStddev, Ratio
from calgraph.io.strict_model import StrictModel


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
