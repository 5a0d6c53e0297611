"""Stamps of sensors that measure at a period, without the irregularity that operating systems add."""

import numpy as np

from calgraph.geometry import STDDEV_PER_MAD, Array

# Messages before and after one through whose stamps a line is fitted: over some seconds, periods of motors stay
# the same, and stamps that are rounded to 10 ms have an error of 0.4 ms. Fewer than these determine no line.
_LINE, _MIN_LINE = 30, 5
# By how much a step differs from a multiple of the period, as a share of it, where a clock jumped.
_MAX_IRREGULARITY = 0.25
# Until the weights of stamps that are late stay the same.
_REWEIGHTINGS = 4


def smooth_stamps(stamps: Array) -> tuple[float, Array]:
    """The period of stamps, s, and what they would be (M,) of a sensor whose period varies slowly.

    Each is that of a line through its neighbours over the number of the message, by iteratively reweighted least
    squares. Where steps are no multiples of the period, clocks jump or sweeps are triggered: no line crosses them.
    """
    if len(stamps) < _MIN_LINE:
        return 0.0, stamps
    steps = np.diff(stamps)
    period = float(np.median(steps))
    count = np.maximum(np.rint(steps / period), 1)
    broken = (np.abs(steps - count * period) > _MAX_IRREGULARITY * period) | (count > _LINE)
    number = np.concatenate([[0.0], np.cumsum(count)])
    run = np.concatenate([[0], np.cumsum(broken)])
    near = np.arange(len(stamps))[:, None] + np.arange(-_LINE, _LINE + 1)
    inside = np.clip(near, 0, len(stamps) - 1)
    weight = ((near == inside) & (run[inside] == run[:, None])).astype(np.float64)
    used = weight.sum(axis=1) >= _MIN_LINE
    near, inside, weight = near[used], inside[used], weight[used]
    x, y = number[inside] - number[used][:, None], stamps[inside] - stamps[used][:, None]
    robust = weight
    for _ in range(_REWEIGHTINGS):
        s, sx, sxx, sy, sxy = (np.sum(robust * one, axis=1) for one in (np.ones_like(x), x, x**2, y, x * y))
        slope = (s * sxy - sx * sy) / (s * sxx - sx**2)
        level = (sy - slope * sx) / s
        r = y - level[:, None] - slope[:, None] * x
        scale = 3 * STDDEV_PER_MAD * np.median(np.abs(r[weight > 0])) + 1e-6
        robust = weight / (1 + (r / scale) ** 2) ** 2
    smooth = stamps.copy()
    smooth[used] += level
    # Rounded steps have another median than mean.
    return (float(steps[~broken].sum() / count[~broken].sum()) if used.any() else period), smooth
