"""A tree of frames, as a URDF or tf describes it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array, se3

MAX_DISTANCE = 1e8
"""m, of a frame from another in a file that is read: frames of the Earth's centre are 6.4e6 m away. More is no
place, and its square overflows."""


@dataclass(frozen=True, eq=False)
class FrameLink:
    """The transform from a frame to its parent."""

    parent: str
    T_parent_child: Array
    """(4, 4); of a movable joint at its zero position."""
    movable: str = ""
    """Description of a movable joint, for messages; empty for a fixed one."""


@dataclass(frozen=True, eq=False)
class FrameTree:
    """Frames with the transforms between them."""

    source: str
    """What describes them, for messages."""
    links: Mapping[str, FrameLink]
    """The link to its parent, by frame; the top frames are not in it."""

    @property
    def frames(self) -> set[str]:
        """The names of all frames."""
        return set(self.links) | {hanging.parent for hanging in self.links.values()}

    def ancestry(self, frame: str) -> list[str]:
        """The frame, its parent, and so on up to the top.

        Raises:
            InputError: the frames form a cycle.
        """
        chain = [frame]
        while chain[-1] in self.links:
            chain.append(self.links[chain[-1]].parent)
            if chain[-1] in chain[:-1]:
                raise InputError(f"the frames of {self.source} form a cycle through {chain[-1]!r}")
        return chain

    def transform_to_ancestor(self, upper: str, lower: str) -> Array:
        """``T_upper_lower`` (4, 4) of a frame and one of its ancestors, with nothing movable between them."""
        T_upper_lower = np.eye(4)
        while lower != upper:
            self.check_fixed(lower)
            T_upper_lower = self.links[lower].T_parent_child @ T_upper_lower
            lower = self.links[lower].parent
        return T_upper_lower

    def transform(self, a: str, b: str) -> Array:
        """``T_a_b`` (4, 4) of any two frames.

        Raises:
            InputError: nothing connects them, or something movable is between them.
        """
        above_a = self.ancestry(a)
        shared = next((frame for frame in self.ancestry(b) if frame in above_a), None)
        if shared is None:
            raise InputError(f"frames {a!r} and {b!r} of {self.source} are not connected")
        return np.asarray(
            se3.inverse(self.transform_to_ancestor(shared, a)) @ self.transform_to_ancestor(shared, b)
        )

    def check_fixed(self, frame: str) -> None:
        """Raises InputError if the joint between a frame and its parent is movable."""
        movable = self.links[frame].movable
        if movable:
            raise InputError(f"{movable}, but lies between calibrated sensors, which must be fixed to each other")
