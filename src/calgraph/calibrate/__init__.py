"""The two stories, one screen each: from a recording to a calibrated tree of transforms."""

from calgraph.calibrate.dispatch import calibrate
from calgraph.calibrate.network import DEPTHS, calibrate_network, calibrate_tracks
from calgraph.calibrate.options import NetworkEstimator, Options, Progress, Weights, silent
from calgraph.calibrate.rig import (
    calibrate_detections,
    calibrate_rig,
    capture_board,
    pose_problem,
    prepare,
    solve_problem,
)
from calgraph.calibrate.track_recording import follow_people
from calgraph.calibrate.validate import audit_problem, check_network, verify_problem

__all__ = [
    "DEPTHS",
    "NetworkEstimator",
    "Options",
    "Progress",
    "Weights",
    "audit_problem",
    "calibrate",
    "calibrate_detections",
    "calibrate_network",
    "calibrate_rig",
    "calibrate_tracks",
    "capture_board",
    "check_network",
    "follow_people",
    "pose_problem",
    "prepare",
    "silent",
    "solve_problem",
    "verify_problem",
]
