"""How far a pose can be relied on, in words a person can act on."""

import numpy as np

from calgraph.geometry import Array
from calgraph.result import Verdict

# Standard deviations (m, rad) beyond which a direction is called weak, and unobservable.
_WEAK = (0.02, np.radians(0.5))
_UNOBSERVABLE = (0.2, np.radians(10))

_SCANNER_AXES = ("forward (x)", "sideways (y)", "height (z)", "roll (about x)", "pitch (about y)", "yaw (about z)")
_CAMERA_AXES = ("sideways (x)", "height (y)", "depth (z)", "pitch (about x)", "yaw (about y)", "roll (about z)")


def verdict(name: str, kind: str, T_root_sensor: Array, covariance: Array) -> Verdict:
    """Grades a pose and names its weak directions along the sensor's own axes.

    Args:
        name: the sensor.
        kind: camera, lidar2d or lidar3d; decides what its axes are called.
        T_root_sensor: (4, 4).
        covariance: (6, 6) in the root's fixed axes.

    Returns:
        The verdict; its reason is empty for a good pose.
    """
    to_sensor = np.kron(np.eye(2), T_root_sensor[:3, :3].T)
    stddev = np.sqrt(np.maximum(np.diag(to_sensor @ covariance @ to_sensor.T), 0))
    axes = _CAMERA_AXES if kind == "camera" else _SCANNER_AXES
    open_axes = [
        axis for axis, s, limit in zip(axes, stddev, np.repeat(_UNOBSERVABLE, 3), strict=True) if s > limit
    ]
    weak_axes = [
        f"{axis} ±{_size(s, i)}"
        for i, (axis, s, limit) in enumerate(zip(axes, stddev, np.repeat(_WEAK, 3), strict=True))
        if s > limit and axis not in open_axes
    ]
    advice = f"tilt and turn the board more, in different places, while {name} and others see it"
    if open_axes:
        return Verdict("unobservable", f"{_listed(open_axes)} fixed by no capture; {advice}")
    if weak_axes:
        return Verdict("weak", f"{', '.join(weak_axes)} of {name}: {advice}")
    return Verdict("good")


def _size(stddev: float, axis: int) -> str:
    return f"{stddev * 1000:.0f} mm" if axis < 3 else f"{np.degrees(stddev):.1f}°"


def _listed(names: list[str]) -> str:
    if len(names) == 1:
        return f"{names[0]} is"
    return f"{', '.join(names[:-1])} and {names[-1]} are"
