"""People who swing their arms: a torso that twists and two arms, each a separate body.

Arms swing in antiphase, one period a stride, and the shoulders turn with them. The phase is a function of the
distance walked, so that arms rest where the walk does.
"""

from dataclasses import replace

import numpy as np

from calgraph.geometry import Array
from calgraph.simulation.network_walks import SAMPLE_INTERVAL, SimulatedWalk

_STRIDE_LENGTH = 1.33
"""Length of a stride, two steps, m: 0.9 strides a second at 1.2 m/s."""
_FULL_SWING_SPEED = 0.8
"""Minimum speed of the full swing, m/s; below it the swing is proportional to the speed."""
_ARM_RADII = np.array([0.045, 0.06])
"""Radii of an arm, across and along the heading, m."""
_SHOULDER_TWIST = 0.3
"""Turn of the shoulders per swing of the arms, rad/m."""


def add_arms(walk: SimulatedWalk, swing: float) -> tuple[SimulatedWalk, ...]:
    """Adds both arms to the torso of a walking person; the walk alone if the swing is 0.

    Args:
        walk: of the torso, before it twists.
        swing: amplitude of the arms, m.
    """
    if swing == 0:
        return (walk,)
    speed = np.linalg.norm(np.gradient(walk.positions, SAMPLE_INTERVAL, axis=0), axis=1)
    phase = 2 * np.pi / _STRIDE_LENGTH * SAMPLE_INTERVAL * np.cumsum(speed)
    forward = swing * np.minimum(speed / _FULL_SWING_SPEED, 1) * np.sin(phase)
    torso = replace(walk, headings=walk.headings - _SHOULDER_TWIST * forward)
    return torso, _build_arm(torso, 1.0, forward), _build_arm(torso, -1.0, -forward)


def _build_arm(torso: SimulatedWalk, side: float, forward: Array) -> SimulatedWalk:
    """The arm on the left (1) or right (-1), ``forward`` (K,) of its shoulder, m."""
    c, s = np.cos(torso.headings), np.sin(torso.headings)
    ahead, left = np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)
    positions = torso.positions + side * torso.axes[0] * left + forward[:, None] * ahead
    return replace(torso, axes=_ARM_RADII, positions=positions)
