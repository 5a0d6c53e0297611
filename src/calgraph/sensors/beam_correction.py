"""Points of scanners without the systematic errors of their beams."""

from collections.abc import Sequence

import numpy as np

from calgraph.geometry import Array, so3
from calgraph.geometry.arrays import measure_lengths
from calgraph.sensors.kinds.stated import BeamError, list_turns

# Newton steps to the true range. Errors are at most some per cent of it, 4 % of a depth camera at 10 m, and their
# squares decrease with each step: 1e-3, 1e-6, 1e-12.
_NEWTON_STEPS = 3


def correct_points(points: Array, errors: Sequence[BeamError], values: Sequence[float], ring_bias: Array) -> Array:
    """Points (N, 3) as they were measured, without the systematic errors of their beams, sensor frame, m.

    The model is that of :class:`calgraph.rig.bundle.range_observations.RangeObservations`: a beam with the
    published unit vector ``u`` has the range ``r + b + Σ v l(u) rᵖ`` where the true one is ``r``, along ``u``
    turned by ``Σ v t(u)``. Points that are not finite, and those at the origin, remain as they are.

    Args:
        points: as published.
        errors: which lengthen ranges (l, p) or turn beams (t).
        values: v of each, in its unit.
        ring_bias: b (N,) of the ring of each beam, m.
    """
    corrected = np.array(points, dtype=np.float64)
    measured = np.isfinite(corrected).all(axis=1) & corrected.any(axis=1)
    ranges = measure_lengths(corrected[measured])
    directions = corrected[measured] / ranges[:, None]
    lengthening = [
        (value * error.lengthen(directions), error.power)
        for error, value in zip(errors, values, strict=True)
        if error.lengthen
    ]
    expected = ranges - ring_bias[measured]
    r = expected
    for _ in range(_NEWTON_STEPS):
        excess = r - expected + sum(size * r**power for size, power in lengthening)
        r = r - excess / (1 + sum(size * power * r ** max(power - 1, 0) for size, power in lengthening))
    turns = [value for error, value in zip(errors, values, strict=True) if error.turn]
    turned = so3.rotate(np.einsum("ien,e->ni", list_turns(errors, directions), turns), directions)
    corrected[measured] = r[:, None] * turned
    return corrected
