"""How far a pose can be relied on, in words a person can act on."""

from collections.abc import Mapping, Sequence

import numpy as np

from calgraph.geometry import Array
from calgraph.pairwise import PairwiseEstimate
from calgraph.result import Verdict

# Standard deviations (m, rad) beyond which a direction is called weak, and unobservable.
WEAK_STDDEV = (0.02, np.radians(0.5))
_UNOBSERVABLE_STDDEV = (0.2, np.radians(10))

# How many times farther apart two sensors' detections may be than their noise explains.
_EXCESS = 3.0
_CAUSES = {
    "camera": "its intrinsics, and the sizes of the printed tags or squares",
    "lidar2d": "its range and angle noise, and that its ranges and angles are in m and rad",
    "lidar3d": "its range and angle noise, and that its points are in m",
}

_SCANNER_AXES = ("forward (x)", "sideways (y)", "height (z)", "roll (about x)", "pitch (about y)", "yaw (about z)")
_CAMERA_AXES = ("sideways (x)", "height (y)", "depth (z)", "pitch (about x)", "yaw (about y)", "roll (about z)")


def axis_names(kind: str) -> tuple[str, ...]:
    """What the six axes of a sensor are called: along x, y, z, and about them."""
    return _CAMERA_AXES if kind == "camera" else _SCANNER_AXES


def grade_pose(
    name: str,
    kind: str,
    T_root_sensor: Array,
    covariance: Array,
    inconsistency: str = "",
    ambiguity: float = 0.0,
    *,
    evidence: str = "capture",
    advice: str = "tilt and turn the board more, in different places, while {name} and others see it",
) -> Verdict:
    """Grades a pose and names its weak directions along the sensor's own axes.

    Args:
        name: the sensor.
        kind: camera, lidar2d or lidar3d; decides what its axes are called.
        T_root_sensor: (4, 4).
        covariance: (6, 6) in the root's fixed axes.
        inconsistency: why the pose cannot be good whatever its covariance (:func:`find_inconsistent_sensors`), or
            empty.
        ambiguity: angle to another pose that the captures allow as well, rad; 0 where there is none.
        evidence: what directions are fixed by, in the singular.
        advice: what makes a weak direction better, with the sensor's name in it as ``{name}``.

    Returns:
        The verdict; its reason is empty for a good pose.
    """
    to_sensor = np.kron(np.eye(2), T_root_sensor[:3, :3].T)
    stddev = np.sqrt(np.maximum(np.diag(to_sensor @ covariance @ to_sensor.T), 0))
    axes = axis_names(kind)
    open_axes = [
        axis for axis, s, limit in zip(axes, stddev, np.repeat(_UNOBSERVABLE_STDDEV, 3), strict=True) if s > limit
    ]
    weak_axes = [
        f"{axis} ±{_format_stddev(s, i)}"
        for i, (axis, s, limit) in enumerate(zip(axes, stddev, np.repeat(WEAK_STDDEV, 3), strict=True))
        if s > limit and axis not in open_axes
    ]
    advice = advice.format(name=name)
    if open_axes or ambiguity:
        fixed = [f"{_join_axes(open_axes, name)} fixed by no {evidence}"] if open_axes else []
        if ambiguity:
            fixed.append(f"a pose turned by {np.degrees(ambiguity):.0f}° fits as well")
        if weak_axes:
            fixed.append(f"hardly fixed: {', '.join(weak_axes)}")
        return Verdict("unobservable", "; ".join([*fixed, *([inconsistency] if inconsistency else []), advice]))
    weaknesses = [inconsistency] if inconsistency else []
    if weak_axes:
        weaknesses.append(f"{', '.join(weak_axes)} of {name}: {advice}")
    return Verdict("weak", "; ".join(weaknesses)) if weaknesses else Verdict("good")


def find_ambiguous_poses(kinds: Mapping[str, str], pairs: Sequence[PairwiseEstimate]) -> dict[str, float]:
    """Angles (rad) to other poses that fit as well, by 2-D scanner; none where one pair leaves but one pose."""
    angles = {
        name: [p.alternative_pose_angle for p in pairs if _is_pair_with_plane(p, name, kinds)]
        for name, kind in kinds.items()
        if kind == "lidar2d"
    }
    return {name: min(found) for name, found in angles.items() if found and min(found) > 0}


def _is_pair_with_plane(pair: PairwiseEstimate, name: str, kinds: Mapping[str, str]) -> bool:
    """Whether the pair is of a sensor and of one that sees the board as a plane."""
    ends = {pair.sensor_a, pair.sensor_b}
    return name in ends and all(kinds[other] != "lidar2d" for other in ends - {name})


def find_inconsistent_sensors(
    root: str, kinds: Mapping[str, str], pairs: Sequence[PairwiseEstimate]
) -> dict[str, str]:
    """Sensors whose detections fit nobody else's, and why that makes their poses doubtful.

    A wrong focal length or a wrong size of the print shifts all that a camera sees by the same factor. Consensus
    keeps such detections, and their scatter hardly shows the error: only that no other sensor explains them does.

    Args:
        root: the root sensor; if its own detections fit nobody else's, no pose can be trusted.
        kinds: camera, lidar2d or lidar3d, by connected sensor.
        pairs: the estimates between them, at the joint solution.

    Returns:
        The reason in words, by sensor; no entry for one whose detections fit at least one other sensor's.
    """
    least = {
        name: min((pair.normalized_rms for pair in pairs if name in (pair.sensor_a, pair.sensor_b)), default=1.0)
        for name in kinds
    }
    reasons = {
        name: f"what {name} saw is {times:.0f} times farther from what any other sensor saw than noise explains: "
        f"check {_CAUSES[kinds[name]]}"
        for name, times in least.items()
        if times > _EXCESS
    }
    if root in reasons:
        return {name: reasons.get(name, reasons[root]) for name in kinds if name != root}
    return reasons


def _format_stddev(stddev: float, axis: int) -> str:
    return f"{stddev * 1000:.0f} mm" if axis < 3 else f"{np.degrees(stddev):.1f}°"


def _join_axes(axes: list[str], name: str) -> str:
    if len(axes) == 1:
        return f"{axes[0]} of {name} is"
    return f"{', '.join(axes[:-1])} and {axes[-1]} of {name} are"
