"""Extrinsic calibration of rigs of cameras, 2-D laser scanners and 3-D LiDARs from one recording.

The steps of the command line as functions on NumPy arrays and frozen dataclasses. ``import calgraph`` itself takes
no time: a name is imported when it is first used. Type checkers read ``__init__.pyi``.
"""

from importlib import import_module

_NAMES = {
    "calgraph.calibration.dispatch": "calibrate",
    "calgraph.network.pipeline": "calibrate_network calibrate_tracks",
    "calgraph.drive.pipeline": "calibrate_drive",
    "calgraph.drive.options": "DriveOptions",
    "calgraph.rig.pipeline": (
        "build_problem build_problem_from_captures calibrate_detections calibrate_rig solve_problem"
    ),
    "calgraph.rig.captures.detect": "CaptureSet",
    "calgraph.rig.captures.from_detections": "captures_from_detections",
    "calgraph.config": (
        "Board CameraSpec Cylinder DepthCameraSpec Intrinsics Lidar2dSpec Lidar3dSpec People PixelNoise "
        "RangeNoise Rig Surroundings Tag load_rig"
    ),
    "calgraph.boards.detections": "BoardCorners PlanePatch Segment",
    "calgraph.rig.detection.from_measurements": (
        "board_corners_from_pixels plane_patch_from_points segment_from_points"
    ),
    "calgraph.errors": "CalgraphError CalibrationError InputError RecordingError Rejected",
    "calgraph.rig.bundle.problem": "Problem",
    "calgraph.rig.bundle.problem_file": "load_problem save_problem",
    "calgraph.geometry": "plane se2 se3 so3",
    "calgraph.graph.pose_graph": "PoseGraph PoseGraphSolution",
    "calgraph.graph.tree_consensus": "average_poses",
    "calgraph.network.options": "NetworkOptions",
    "calgraph.rig.pairs.board_pair": "estimate_pair",
    "calgraph.graph.pairwise_estimate": "PairwiseEstimate",
    "calgraph.recording": "MessageRecording RecordingCache open_recording open_recordings",
    "calgraph.report": "write_report",
    "calgraph.result": "Calibration SensorPose export load_calibration save_calibration to_dataframe",
    "calgraph.rig.options": "RigOptions",
    "calgraph.rig.verification": "bootstrap_covariances",
    "calgraph.sensors": "CameraModel Image LaserScan PointCloud colorize_points",
    "calgraph.network.tracking.track_scanner": "track_scanner",
    "calgraph.network.tracking.track": "ScannerTracks Track",
}
"""By module, what it offers here."""
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}
__all__ = sorted(_MODULES)  # noqa: PLE0605


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found: object = getattr(import_module(_MODULES[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return __all__
