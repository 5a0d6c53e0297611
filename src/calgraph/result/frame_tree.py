"""Frames that hang from each other, as a URDF or tf describes them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array, se3


@dataclass(frozen=True, eq=False)
class Hanging:
    """How a frame hangs from its parent."""

    parent: str
    T_parent_child: Array
    """(4, 4); of a movable joint at its zero position."""
    movable: str = ""
    """What is to be said of a joint that moves; empty for one that is fixed."""


@dataclass(frozen=True, eq=False)
class FrameTree:
    """Frames with the transforms between them."""

    source: str
    """What describes them, for messages."""
    above: Mapping[str, Hanging]
    """By frame, how it hangs; frames that others only hang from are not in it."""

    @property
    def frames(self) -> set[str]:
        """The names of all frames."""
        return set(self.above) | {hanging.parent for hanging in self.above.values()}

    def upwards(self, frame: str) -> list[str]:
        """The frame, its parent, and so on up to the top.

        Raises:
            InputError: the frames hang in a circle.
        """
        line = [frame]
        while line[-1] in self.above:
            line.append(self.above[line[-1]].parent)
            if line[-1] in line[:-1]:
                raise InputError(f"the frames of {self.source} form a circle through {line[-1]!r}")
        return line

    def chain(self, upper: str, lower: str) -> Array:
        """``T_upper_lower`` (4, 4) of a frame and one of its ancestors, with nothing movable between them."""
        T_upper_lower = np.eye(4)
        while lower != upper:
            self.check_fixed(lower)
            T_upper_lower = self.above[lower].T_parent_child @ T_upper_lower
            lower = self.above[lower].parent
        return T_upper_lower

    def transform(self, a: str, b: str) -> Array:
        """``T_a_b`` (4, 4) of any two frames.

        Raises:
            InputError: nothing connects them, or something movable is between them.
        """
        above_a = self.upwards(a)
        shared = next((frame for frame in self.upwards(b) if frame in above_a), None)
        if shared is None:
            raise InputError(f"frames {a!r} and {b!r} of {self.source} are not connected")
        return np.asarray(se3.inverse(self.chain(shared, a)) @ self.chain(shared, b))

    def check_fixed(self, frame: str) -> None:
        """Refuses what moves between a frame and its parent."""
        movable = self.above[frame].movable
        if movable:
            raise InputError(f"{movable}, but lies between calibrated sensors, which must be fixed to each other")
