"""Real recordings against the answers that came with them.

python benchmarks/real_recordings.py [DATA]      # the folder of real recordings; CALGRAPH_DATA or ../shared/data
"""

import csv
import os
import sys
from pathlib import Path

import numpy as np

from calgraph.config import Rig
from calgraph.geometry import Array, se3, so3
from calgraph.recording import open_recording
from calgraph.result import Calibration, Edge
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import calibrate_rig

DATA = Path(os.environ.get("CALGRAPH_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
"""The folder of real recordings."""
VLP16: dict[str, object] = {
    "root": "lidar",
    "target": {
        "kind": "board",
        "size": [0.85, 0.61],
        "pattern": {"kind": "checkerboard", "columns": 7, "rows": 5, "square": 0.095},
    },
    "sensors": {
        "camera": {
            "kind": "camera",
            "topic": "images",
            "intrinsics": {
                "model": "fisheye",
                "width": 1920,
                "height": 1208,
                "K": [1176.93, 1177.72, 962.275, 612.725],
                "distortion": [-0.0540096, -0.0784275, 0.0959641, -0.0515253],
            },
        },
        "lidar": {"kind": "lidar3d", "topic": "pcd_full"},
    },
    # By which the published solutions scatter.
    "tolerance": {"translation": "35 mm", "rotation": "1 deg"},
}

WALL: dict[str, object] = {
    "root": "camera",
    "target": {
        "kind": "board",
        "size": [0.50, 0.30],
        "pattern": {"kind": "checkerboard", "columns": 11, "rows": 8, "square": 0.019},
    },
    "sensors": {
        "camera": {
            "kind": "camera",
            "topic": "images",
            "intrinsics": {
                "width": 640,
                "height": 480,
                "K": [505.29124569, 504.55350189, 322.19927863, 236.33609581],
                "distortion": [0.18421732, -0.31277364, -0.00041421, 0.00039006, -0.07993784],
            },
        },
        "laser": {"kind": "lidar2d", "topic": "lasers"},
    },
    # Five poses determine no direction better than this.
    "tolerance": {"translation": "5 cm", "rotation": "2 deg"},
}


def calibrated(rig: dict[str, object], folder: Path) -> Calibration:
    """Calibrates a plain folder."""
    with open_recording(folder) as recording:
        return calibrate_rig(Rig.model_validate(rig), recording, RigOptions())


def vlp16(data: Path) -> Calibration:
    """Fisheye camera and VLP-16, 16 poses of a checkerboard, whole sweeps, no background."""
    return calibrated(VLP16, data / "acfr-vlp16-checkerboard")


def wall(data: Path) -> Calibration:
    """Camera and 2-D scanner, five poses of a board that always stood upright."""
    return calibrated(WALL, data / "acfr-rpg-camera-2dlidar")


def published(data: Path) -> Array:
    """Mean of the published solutions: pose of the camera in the LiDAR's frame, Rz Ry Rx."""
    with (data / "acfr-vlp16-checkerboard/calibration_quickstart.csv").open() as file:
        rows = np.array([[float(cell) for cell in row] for row in list(csv.reader(file))[1:]])
    roll, pitch, yaw, *xyz = rows.mean(axis=0)
    R = so3.exp(np.array([0, 0, yaw])) @ so3.exp(np.array([0, pitch, 0])) @ so3.exp(np.array([roll, 0, 0]))
    return se3.pose(R, np.array(xyz))


def main() -> None:
    """Prints poses, deviations from the answers, and verdicts."""
    data = Path(sys.argv[1]) if len(sys.argv) > 1 else DATA
    found = vlp16(data)
    camera, edge = found["camera"], found.evidence.edges[0]
    difference = se3.difference(camera.T_root_sensor, published(data))
    spread = np.sqrt(np.diag(camera.covariance))
    print(f"acfr-vlp16-checkerboard: {agreement(edge)}")
    print(f"  from the published answer: {1000 * np.linalg.norm(difference[:3]):.1f} mm (x y z", end=" ")
    print(
        f"{(1000 * difference[:3]).round(1).tolist()}), {np.degrees(np.linalg.norm(difference[3:])):.2f} degrees"
    )
    print(f"  standard deviations {(1000 * spread[:3]).round(1).tolist()} mm,", end=" ")
    print(f"{np.degrees(spread[3:]).round(2).tolist()} degrees; {camera.verdict.grade}")
    print("".join(f"  {remark}\n" for remark in found.evidence.remarks), end="")
    found = wall(data)
    laser, edge = found["laser"], found.evidence.edges[0]
    lateral, _, forward = laser.T_root_sensor[:3, 3]
    yaw = np.degrees(np.arctan2(-laser.T_root_sensor[0, 0], laser.T_root_sensor[2, 0]))
    print(f"acfr-rpg-camera-2dlidar: {agreement(edge)}")
    print(f"  lateral {1000 * lateral:.0f} mm, forward {1000 * forward:.0f} mm, yaw {yaw:.1f} degrees", end=" ")
    print("(by hand: -17 mm, -106 mm, 2.4 degrees to one side)")
    print(f"  {laser.verdict.grade}: {laser.verdict.reason}")


def agreement(edge: Edge) -> str:
    """How many captures a pair kept, and how far apart its detections are."""
    distance = 1000 * float(np.sqrt(np.mean(edge.residuals**2)))
    return f"{edge.inliers} of {edge.captures} captures, RMS {distance:.1f} mm"


if __name__ == "__main__":
    main()
