"""Real recordings with an answer of their own: what calibrate makes of them, from the files to the verdict."""

import csv
from pathlib import Path

import numpy as np
import pytest

from calgraph.calibrate import Options, calibrate_rig
from calgraph.geometry import Array, se3, so3
from calgraph.recording import open_recording
from calgraph.result import Calibration
from calgraph.rig import Rig

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
            "topic": "camera",
            "intrinsics": {
                "model": "fisheye",
                "width": 1920,
                "height": 1208,
                "K": [1176.93, 1177.72, 962.275, 612.725],
                "distortion": [-0.0540096, -0.0784275, 0.0959641, -0.0515253],
            },
        },
        "lidar": {"kind": "lidar3d", "topic": "lidar"},
    },
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
            "topic": "camera",
            "intrinsics": {
                "width": 640,
                "height": 480,
                "K": [505.29124569, 504.55350189, 322.19927863, 236.33609581],
                "distortion": [0.18421732, -0.31277364, -0.00041421, 0.00039006, -0.07993784],
            },
        },
        "laser": {"kind": "lidar2d", "topic": "laser"},
    },
}


def calibrated(rig: dict[str, object], folder: Path) -> Calibration:
    with open_recording(folder) as recording:
        return calibrate_rig(Rig.model_validate(rig), recording, Options())


def linked(folder: Path, files: dict[str, Path]) -> None:
    folder.mkdir(parents=True)
    for name, file in files.items():
        (folder / name).symlink_to(file)


@pytest.fixture(scope="module")
def vlp16(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    folder = tmp_path_factory.mktemp("vlp16")
    data = data_dir / "acfr-vlp16-checkerboard"
    poses = sorted(int(image.stem.removeprefix("pose")) for image in data.glob("images/*.png"))
    linked(folder / "camera", {f"{10 * i}.png": data / f"images/pose{i}.png" for i in poses})
    linked(folder / "lidar", {f"{10 * i}.pcd.gz": data / f"pcd_full/pose{i}_full.pcd.gz" for i in poses})
    return calibrated(VLP16, folder)


@pytest.fixture(scope="module")
def wall(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    folder = tmp_path_factory.mktemp("wall")
    data = data_dir / "acfr-rpg-camera-2dlidar"
    linked(folder / "camera", {file.name: file for file in data.glob("images/*.png")})
    linked(folder / "laser", {file.name: file for file in data.glob("lasers/*.pcd")})
    return calibrated(WALL, folder)


def published(data: Path) -> Array:
    """Mean of the published solutions: pose of the camera in the LiDAR's frame, Rz Ry Rx."""
    with (data / "acfr-vlp16-checkerboard/calibration_quickstart.csv").open() as file:
        rows = np.array([[float(cell) for cell in row] for row in list(csv.reader(file))[1:]])
    roll, pitch, yaw, *xyz = rows.mean(axis=0)
    R = so3.exp(np.array([0, 0, yaw])) @ so3.exp(np.array([0, pitch, 0])) @ so3.exp(np.array([roll, 0, 0]))
    return se3.pose(R, np.array(xyz))


def test_a_camera_and_a_lidar_agree_with_the_published_answer(vlp16: Calibration, data_dir: Path) -> None:
    """16 poses, whole sweeps, a person beside the board, no background: found by size, shape and consensus."""
    difference = se3.difference(vlp16["camera"].T_root_sensor, published(data_dir))
    assert np.linalg.norm(difference[:3]) < 0.03
    assert np.degrees(np.linalg.norm(difference[3:])) < 0.5
    assert vlp16.edges[0].inliers >= 15
    assert vlp16.edges[0].residuals.max() < 0.02
    assert vlp16["camera"].verdict.grade == "good"


def test_an_upright_board_fixes_three_of_six_directions_and_the_verdict_names_the_others(
    wall: Calibration,
) -> None:
    verdict = wall["laser"].verdict
    assert verdict.grade == "unobservable"
    for direction in ("height", "roll", "pitch"):
        assert direction in verdict.reason
    for direction in ("forward", "sideways", "yaw"):
        assert direction not in verdict.reason


def test_what_an_upright_board_does_fix_agrees_with_a_fit_by_hand(wall: Calibration) -> None:
    """Five poses: lateral -17 mm, forward -106 mm, yaw 2.4 degrees, as the data's README has it."""
    laser = wall["laser"]
    lateral, _, forward = laser.T_root_sensor[:3, 3]
    x_laser = laser.T_root_sensor[:3, 0]
    yaw = np.degrees(np.arctan2(-x_laser[0], x_laser[2]))
    assert abs(lateral + 0.017) < 0.02
    assert abs(forward + 0.106) < 0.02
    assert abs(abs(yaw) - 2.4) < 1.5
