"""Extrinsic calibration of rigs of cameras, 2-D laser scanners and 3-D LiDARs from one recording.

The steps of the command line as functions on NumPy arrays and frozen dataclasses. Names are re-exported from
their packages, which are loaded on first use: ``import calgraph`` itself takes no time.
"""

from typing import TYPE_CHECKING

from calgraph.lazy_names import import_on_use

if TYPE_CHECKING:
    from calgraph.calibrate import (
        NetworkOptions,
        RigOptions,
        bootstrap_covariances,
        build_problem,
        build_problem_from_captures,
        calibrate_detections,
        calibrate_network,
        calibrate_rig,
        calibrate_tracks,
        solve_problem,
    )
    from calgraph.captures import CaptureSet, captures_from_detections
    from calgraph.config import (
        Board,
        CameraSpec,
        Cylinder,
        Intrinsics,
        Lidar2dSpec,
        Lidar3dSpec,
        People,
        PixelNoise,
        RangeNoise,
        Rig,
        Tag,
        load_rig,
    )
    from calgraph.detection import (
        BoardCorners,
        PlanePatch,
        Segment,
        board_corners_from_pixels,
        plane_patch_from_points,
        segment_from_points,
    )
    from calgraph.errors import CalgraphError, CalibrationError, InputError, RecordingError, Rejected
    from calgraph.estimation import Problem, load_problem, save_problem
    from calgraph.geometry import plane, se2, se3, so3
    from calgraph.graph import PoseGraph, PoseGraphSolution, average_poses
    from calgraph.pairwise import PairwiseEstimate, estimate_pair
    from calgraph.recording import MessageRecording, RecordingCache, open_recording, open_recordings
    from calgraph.report import write_report
    from calgraph.result import Calibration, SensorPose, export, load_calibration, save_calibration, to_dataframe
    from calgraph.sensors import CameraModel, Image, LaserScan, PointCloud, colorize_points
    from calgraph.tracking import ScannerTracks, Track, track_scanner

__all__ = [
    "Board", "BoardCorners", "CalgraphError", "Calibration", "CalibrationError", "CameraModel",
    "CameraSpec", "CaptureSet", "Cylinder", "Image", "InputError", "Intrinsics", "LaserScan",
    "Lidar2dSpec", "Lidar3dSpec", "MessageRecording", "NetworkOptions", "PairwiseEstimate", "People",
    "PixelNoise", "PlanePatch", "PointCloud", "PoseGraph", "PoseGraphSolution", "Problem", "RangeNoise",
    "RecordingCache", "RecordingError", "Rejected", "Rig", "RigOptions", "ScannerTracks", "Segment",
    "SensorPose", "Tag", "Track", "average_poses", "board_corners_from_pixels", "bootstrap_covariances",
    "build_problem", "build_problem_from_captures", "calibrate_detections", "calibrate_network",
    "calibrate_rig", "calibrate_tracks", "captures_from_detections", "colorize_points", "estimate_pair",
    "export", "load_calibration", "load_problem", "load_rig", "open_recording", "open_recordings",
    "plane", "plane_patch_from_points", "save_calibration", "save_problem", "se2", "se3",
    "segment_from_points", "so3", "solve_problem", "to_dataframe", "track_scanner", "write_report",
]  # fmt: skip

if not TYPE_CHECKING:
    __getattr__ = import_on_use(
        __name__,
        [
            "errors", "geometry", "sensors", "io", "config", "result", "recording", "detection", "tracking",
            "captures", "pairwise", "graph", "estimation", "baselines", "diagnostics", "calibrate", "report",
        ],
    )  # fmt: skip


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
