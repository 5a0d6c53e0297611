"""The pipelines of rigs and networks: from a recording to a calibrated tree of transforms."""

from typing import TYPE_CHECKING

from calgraph.lazy_names import import_on_use

if TYPE_CHECKING:
    from calgraph.calibrate.capture_collection import collect_captures
    from calgraph.calibrate.dispatch import calibrate
    from calgraph.calibrate.intrinsics import calibrate_intrinsics
    from calgraph.calibrate.network import calibrate_network, calibrate_tracks
    from calgraph.calibrate.options import (
        NetworkEstimator,
        NetworkOptions,
        Progress,
        RigOptions,
        Weights,
        no_progress,
    )
    from calgraph.calibrate.rig import (
        build_problem,
        build_problem_from_captures,
        calibrate_detections,
        calibrate_rig,
        solve_problem,
    )
    from calgraph.calibrate.track_recording import track_people
    from calgraph.calibrate.validate import bootstrap_covariances, compare_extrinsics, compare_network_extrinsics
else:
    __getattr__ = import_on_use(
        __name__,
        [
            "options",
            "dispatch",
            "capture_collection",
            "rig",
            "intrinsics",
            "validate",
            "network",
            "track_recording",
        ],
    )

__all__ = [
    "NetworkEstimator", "NetworkOptions", "Progress", "RigOptions", "Weights", "bootstrap_covariances",
    "build_problem", "build_problem_from_captures", "calibrate", "calibrate_detections", "calibrate_intrinsics",
    "calibrate_network", "calibrate_rig", "calibrate_tracks", "collect_captures", "compare_extrinsics",
    "compare_network_extrinsics", "no_progress", "solve_problem", "track_people",
]  # fmt: skip
