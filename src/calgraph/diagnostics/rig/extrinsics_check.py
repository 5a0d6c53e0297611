"""Whether given extrinsics of a rig agree with what a recording says of them."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from calgraph.diagnostics.comparison import ExtrinsicsComparison, ResidualComparison, Tolerance, match_poses
from calgraph.errors import CalibrationError
from calgraph.estimation.rig.bundle_solver import Bundle, BundleState, minimize_bundle
from calgraph.estimation.rig.observations import CornerObservations, RangeObservations, relative_poses
from calgraph.estimation.rig.solution import SolvedBundle
from calgraph.geometry import Array
from calgraph.result import Calibration, ExtrinsicsFile


def compare_rig_poses(
    found: Calibration, adjusted: SolvedBundle | None, given: ExtrinsicsFile, tolerance: Tolerance | None = None
) -> ExtrinsicsComparison:
    """Compares given extrinsics with those found.

    A sensor fails along an axis if it is off by more than the tolerance, and by more than chance explains (1 in
    1000, tested over all six axes and along the one). What is significant but within the tolerance is a warning,
    and so is what the recording is too weak to tell. Where more than one sensor fails in the root's frame, the
    frame in which the fewest do is taken: if the root has moved, all others seem to.

    Args:
        found: the calibration that the recording gives.
        adjusted: its solution, for the residuals; None where there is none.
        given: the extrinsics to be judged.
        tolerance: what may be off without harm.

    Raises:
        InputError: the root or all other sensors are not in the file, or nothing fixed connects them there.
    """
    compared = match_poses(found, given, tolerance)
    misfits = _compare_residuals(adjusted, compared.T_root_sensor) if adjusted else {}
    audits = [compared.compare_in_frame(reference, misfits) for reference in compared.frames]
    from_root = next(a for a in audits if a.reference == found.root)
    # One sensor that moved in the frame of another: either did. The root is where people look from.
    best = min(audits, key=lambda a: len(a.failed)) if len(from_root.failed) > 1 else from_root
    return best if len(best.failed) < len(from_root.failed) else from_root


def _compare_residuals(
    adjusted: SolvedBundle, T_root_sensor: Mapping[str, Array]
) -> dict[str, ResidualComparison]:
    """By sensor, its residuals under given poses and under those found, boards placed anew for both."""
    bundle, state = adjusted.bundle, adjusted.minimized.state
    views = tuple(
        own.select(np.full(len(own.board), name in T_root_sensor))
        for name, own in zip(bundle.sensors, bundle.views, strict=True)
    )
    held = replace(bundle.without_outlines(), views=views, body=np.zeros(len(views), dtype=np.intp), priors=())
    poses = [T_root_sensor.get(n, T) for n, T in zip(bundle.sensors, state.T_root_sensor, strict=True)]
    given = _rms_residuals(held, replace(state, T_root_sensor=np.array(poses)))
    found = _rms_residuals(held, state)
    return {
        name: ResidualComparison("px" if isinstance(own, CornerObservations) else "m", given[s], found[s])
        for s, (name, own) in enumerate(zip(bundle.sensors, views, strict=True))
        if len(own.board)
    }


def _rms_residuals(held: Bundle, state: BundleState) -> list[float]:
    """By sensor, the root mean square of what separates its measurements from the boards, px or m."""
    try:
        placed = minimize_bundle(held, state).state
    except CalibrationError:
        # So far off that boards are behind a camera.
        return [float("inf")] * len(held.views)
    sizes = []
    for s, views in enumerate(held.views):
        T_sensor_board = relative_poses(placed.T_root_sensor[s], placed.T_root_board[views.board])
        residual = views.linearize(T_sensor_board, placed.extra[held.extra_indices(s)]).residual
        if isinstance(views, RangeObservations):
            residual = residual * views.sigma[:, None]
        elif isinstance(views, CornerObservations):
            residual = residual * views.noise_scale * views.noise.pixel
        sizes.append(float(np.sqrt(np.mean(residual**2))) if residual.size else 0.0)
    return sizes
