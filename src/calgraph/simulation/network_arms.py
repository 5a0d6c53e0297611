"""People who swing their arms: a torso that twists, and an arm on either side, each a body of its own.

Arms swing in antiphase, once forth and back in a stride, and the shoulders turn with them. Both go by the way that
was walked, so that they rest where the walk does.
"""

from dataclasses import replace

import numpy as np

from calgraph.geometry import Array
from calgraph.simulation.network_walks import SAMPLE, Walk

_STRIDE = 1.33
"""Two steps, m: 0.9 strides a second at 1.2 m/s."""
_FULL = 0.8
"""Speed from which on arms swing fully, m/s; below it, in proportion."""
_ARM = np.array([0.045, 0.06])
"""Radii of an arm, across and along the heading, m."""
_TWIST = 0.3
"""Turn of the shoulders by the swing of the arms, rad/m."""


def with_arms(walk: Walk, swing: float) -> tuple[Walk, ...]:
    """The torso and both arms of a person on a walk; the walk alone if the arms swing by 0.

    Args:
        walk: of the torso, before it twists.
        swing: amplitude of the arms, m.
    """
    if swing == 0:
        return (walk,)
    speed = np.linalg.norm(np.gradient(walk.places, SAMPLE, axis=0), axis=1)
    phase = 2 * np.pi / _STRIDE * SAMPLE * np.cumsum(speed)
    forth = swing * np.minimum(speed / _FULL, 1) * np.sin(phase)
    torso = replace(walk, headings=walk.headings - _TWIST * forth)
    return torso, _arm(torso, 1.0, forth), _arm(torso, -1.0, -forth)


def _arm(torso: Walk, side: float, forth: Array) -> Walk:
    """The arm on the left (1) or right (-1), so far forth (K,) of its shoulder."""
    c, s = np.cos(torso.headings), np.sin(torso.headings)
    ahead, left = np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)
    places = torso.places + side * torso.axes[0] * left + forth[:, None] * ahead
    return replace(torso, axes=_ARM, places=places)
