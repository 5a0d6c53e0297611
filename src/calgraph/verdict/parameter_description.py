"""Deviations of systematic parameters in words."""

from typing import Protocol

import numpy as np

# By quantity, what a positive and what a negative deviation means.
_MEANINGS = {
    "focal length": ("the focal length of {of} is {size} longer than stated", "shorter"),
    "pixel aspect": ("pixels of {of} are {size} narrower for their height than stated", "wider"),
    "cx": ("cx of {of} is {size} larger than stated", "smaller"),
    "cy": ("cy of {of} is {size} larger than stated", "smaller"),
    "range bias": ("ranges of {of} are {size} longer than they should be", "shorter"),
    "range scale": ("ranges of {of} are {size} longer than they should be", "shorter"),
    "angle scale": ("angles between beams of {of} are {size} larger than stated", "smaller"),
    "stretch along x": (
        "ranges of {of} along its x axis are {size} longer than on average, as by a tilt of its scan plane",
        "shorter",
    ),
    "stretch along diagonal": (
        "ranges of {of} at 45° are {size} longer than on average, as by a tilt of its scan plane",
        "shorter",
    ),
    "print scale": ("the print on the {of} is {size} larger than stated", "smaller"),
    "print aspect": ("the print on the {of} is {size} wider for its height than stated", "narrower"),
    "tag size": ("tags on the {of} are {size} larger than stated", "smaller"),
    "stamp delay": ("{of} measures {size} later than its stamps state", "earlier"),
    "readout time": ("{of} reads the last row of an image {size} later than stated", "earlier"),
    "clock drift": ("the clock of {of} is {size} faster than that of the root", "slower"),
    "width": ("the {of} is {size} wider than stated", "narrower"),
    "height": ("the {of} is {size} higher than stated", "lower"),
}
_COMPARATIVES = ("longer", "narrower", "larger", "faster", "wider", "higher", "later")


class DescribedParameter(Protocol):
    """A systematic parameter of a rig or of a network."""

    @property
    def of(self) -> str:
        """A sensor, a board, or a tag."""

    @property
    def quantity(self) -> str:
        """``range bias`` and so on."""

    @property
    def unit(self) -> str:
        """``m``, ``px``, ``rad``, or nothing for ratios."""


def describe_deviation(parameter: DescribedParameter, deviation: float, of: str = "") -> str:
    """How far a parameter is from the stated value, as a clause.

    Args:
        parameter: the parameter.
        deviation: of its value; of a focal length, relative.
        of: what it is a parameter of, where it stands for several.
    """
    of, quantity = of or parameter.of, parameter.quantity
    size = format_size(deviation, parameter)
    if quantity in _MEANINGS:
        sentence, opposite = _MEANINGS[quantity]
        if deviation < 0:
            positive = next(word for word in _COMPARATIVES if f" {word} " in sentence)
            sentence = sentence.replace(f" {positive} ", f" {opposite} ")
        return sentence.format(of=of, size=size)
    if quantity.startswith("bias of ring"):
        longer = "longer" if deviation > 0 else "shorter"
        return (
            f"ranges of {quantity.removeprefix('bias of ')} of {of} are {size} {longer} than those of the others"
        )
    if quantity.startswith("bow along"):
        return f"the {of} is bent by {size} {quantity.removeprefix('bow ')}"
    if quantity.endswith("footprint"):
        return f"edges of the board in scans of {of} are {size} too far {'out' if deviation > 0 else 'in'}"
    if quantity.endswith("rotation"):
        return f"{_printed_thing(of, quantity)} is rotated by {size} from the stated place"
    return f"{_printed_thing(of, quantity)} is {size} along {quantity[-1]} from the stated place"


def _printed_thing(of: str, quantity: str) -> str:
    """A tag, or the print on a board."""
    return f"the print on the {of}" if quantity.startswith("print") else of


def describe_contradiction(deviation: str, ratio: float, prior: str) -> str:
    """A deviation that is too large, as a sentence.

    Args:
        deviation: as of :func:`describe_deviation`.
        ratio: of it to what its prior allows.
        prior: the standard deviation of the prior with its unit.
    """
    return (
        f"{deviation}; this is {ratio:.1f} times its uncertainty in rig.yaml ({prior}): "
        "check it, correct rig.yaml or state a larger uncertainty there, and calibrate again"
    )


def format_size(deviation: float, parameter: DescribedParameter) -> str:
    """The absolute value of a deviation in plain units; of a focal length, relative."""
    size = abs(deviation)
    if parameter.quantity == "clock drift":
        return f"{1e6 * size:.3g} ppm"
    match parameter.unit if parameter.quantity != "focal length" else "":
        case "s":
            return f"{1000 * size:.3g} ms"
        case "m":
            return f"{1000 * size:.3g} mm"
        case "rad":
            return f"{np.degrees(size):.2g}°"
        case "px":
            return f"{size:.3g} px"
    return f"{100 * size:.2g} %"
