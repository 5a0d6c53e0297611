"""The verdict on the frame of a vehicle, and what the drive leaves open."""

from collections.abc import Mapping, Sequence

import numpy as np

from calgraph.config import Rig
from calgraph.drive.adjustment import Adjustment
from calgraph.drive.segments import Segments
from calgraph.drive.vehicle import VehiclePose, Wheels, locate_root
from calgraph.errors import Rejected
from calgraph.geometry import se3
from calgraph.result import BaseFrame, Verdict
from calgraph.verdict.grades import grade_pose

# Error of wheels in 2.4 s from which they contradict the trajectory, m: slip of half a per cent is 2 cm; it was
# 0.2 m where the odometry of a scanner had lost its way.
_MAX_WHEEL_ERROR = 0.1
_ADVICE = "drive for a minute on a level floor, with curves to both sides and straight parts"


def assess_base(
    rig: Rig, used: Sequence[str], tracks: Mapping[str, Segments | Rejected], adjusted: Adjustment | None
) -> BaseFrame | None:
    """The root on the vehicle with a verdict; None without ``base``.

    Args:
        rig: states the frame.
        used: the sensors of the solution.
        tracks: trajectories of all sensors, by themselves.
        adjusted: the solution; None if there is none.
    """
    base = rig.base
    if base is None:
        return None
    found: VehiclePose | Rejected = Rejected("the root has no trajectory")
    if adjusted:
        wheels = None
        if base.wheels is not None and base.wheels in used:
            track = tracks[base.wheels]
            wheels = Wheels(used.index(base.wheels), track) if isinstance(track, Segments) else None
        found = locate_root(adjusted, used.index(rig.root), inverted=base.inverted, wheels=wheels)
    if isinstance(found, Rejected):
        return BaseFrame(base.frame, base.axle, Verdict("unobservable", f"{found.reason}; {_ADVICE}"))
    T, measured = found.T_base_root, ~np.isnan(np.diag(found.covariance))
    t = np.where(measured[:3], T[:3, 3], np.nan)
    t[1] = t[1] if base.y is None else base.y
    # x, which curves determine, belongs to any vehicle; a scan plane has no height, roll and pitch.
    covariance = np.nan_to_num(found.covariance)
    if not measured[0]:
        covariance[0, 0] = np.inf
    missing = f"curves in which {base.wheels} measures" if base.wheels else "base.wheels"
    open_side = (
        f"y of {rig.root} in {base.frame} is not observable from a drive without {missing}: "
        "measure it, and state base.y"
    )
    reasons = [open_side] if np.isnan(t[1]) else []
    if found.wheel_error > _MAX_WHEEL_ERROR:
        reasons.append(
            f"distances of {base.wheels} and of the root differ by {found.wheel_error:.1f} m in 2.4 s: odometry "
            "of one lost its way, or wheels slipped; drive slower, where walls and furniture are near"
        )
    verdict = grade_pose(
        base.frame, rig.sensors[rig.root].kind, np.eye(4), covariance, reasons,
        tolerance=rig.tolerance, settings=rig.settings.diagnostics.verdict,
        data="motions", advice=_ADVICE,
    )  # fmt: skip
    return BaseFrame(base.frame, base.axle, verdict, se3.pose(T[:3, :3], t), found.covariance)
