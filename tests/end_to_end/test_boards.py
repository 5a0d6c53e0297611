"""Rigs calibrated with every kind of board, through images, of straight and of bent lines; several boards."""

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from calgraph.cli.printing import print_calibration
from calgraph.config import AprilGrid, Board, Charuco, Checkerboard, Tag
from calgraph.io.yaml_reading import read_yaml
from calgraph.result import Calibration, save_calibration, save_captures
from calgraph.simulation import (
    CameraOptions,
    GroundTruth,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
)
from simulated_rigs import calibrate, pose_errors, simulate_scenario

pytestmark = pytest.mark.slow

SHEET = (1.0, 0.8)
BOARDS: Mapping[str, Board] = {
    "tags": Board(
        size=SHEET,
        tags=tuple(Tag(id=i, size=0.3, center=c) for i, c in enumerate([(-0.3, 0.2), (0.3, 0.2), (0.0, -0.2)])),
    ),
    "aprilgrid": Board(
        size=SHEET, pattern=AprilGrid(kind="aprilgrid", columns=5, rows=4, tag_size=0.14, tag_spacing=0.3)
    ),
    "charuco": Board(
        size=SHEET,
        pattern=Charuco(kind="charuco", columns=8, rows=6, square=0.12, marker=0.09, dictionary="DICT_4X4_50"),
    ),
    # Smaller, as it has to be in view as a whole.
    "checkerboard": Board(
        size=(0.7, 0.5), pattern=Checkerboard(kind="checkerboard", columns=8, rows=5, square=0.075)
    ),
}
PINHOLE = CameraOptions(count=2, width=560, height=420, field_of_view=110, rate=2.0, texels_per_mm=1.0)
FISHEYE = PINHOLE.model_copy(
    update={"model": "fisheye", "field_of_view": 150.0, "distortion": (0.02, -0.01, 0.003, -0.001)}
)
CAMERAS = RigScenario(
    camera=PINHOLE,
    laser=LaserOptions(count=0),
    spinning=SpinningOptions(count=0),
    bearings=(-15, -8, 0, 8, 15),
    radii=(1.3, 1.8),
    samples=1,
    clutter=3,
    move_time=0.4,
)
BEARINGS = (-45, -35, -25, -15, -5, 5)
LIDAR = MultibeamOptions(count=1, rate=4.0, rings=24, resolution=0.5)


def scenario(**knobs: object) -> RigScenario:
    return CAMERAS.model_copy(update=knobs)


def assert_true(calibration: Calibration, truth: GroundTruth, millimetres: float) -> None:
    assert not calibration.evidence.unconnected
    for name, error in pose_errors(calibration, truth).items():
        assert 1000 * np.linalg.norm(error[:3]) < millimetres, name
        assert np.degrees(np.linalg.norm(error[3:])) < 0.3, name
        assert np.all(np.abs(error) < 5 * np.sqrt(np.diag(calibration[name].covariance))), name


def used(calibration: Calibration, sensor: str) -> int:
    return sum(row.used for row in calibration.evidence.captures if row.sensor == sensor)


@pytest.mark.parametrize("lens", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
@pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS.keys())
def test_two_cameras_are_calibrated_with_every_board(board: Board, lens: CameraOptions) -> None:
    rig, recording, truth = simulate_scenario(scenario(board=board, camera=lens), seed=4)
    calibration = calibrate(rig, recording)
    assert_true(calibration, truth, 10)
    assert used(calibration, "camera_2") >= 5


@pytest.fixture(scope="module")
def two_boards() -> tuple[Calibration, GroundTruth]:
    """A camera and a LiDAR see tags, and a grid beside them: nearly as many board poses again."""
    shown = scenario(
        board=BOARDS["tags"],
        companions=(BOARDS["aprilgrid"],),
        camera=PINHOLE.model_copy(update={"count": 1}),
        multibeam=LIDAR,
        bearings=BEARINGS,
        radii=(1.8,),
    )
    rig, recording, truth = simulate_scenario(shown, seed=3)
    return calibrate(rig, recording), truth


def test_boards_in_one_capture_are_all_used(two_boards: tuple[Calibration, GroundTruth]) -> None:
    calibration, truth = two_boards
    assert_true(calibration, truth, 25)
    (edge,) = calibration.evidence.edges
    assert edge.inliers > len(BEARINGS)


@pytest.mark.parametrize("sensor", ["camera", "lidar"])
def test_terminal_and_files_state_one_number_of_captures(
    sensor: str, two_boards: tuple[Calibration, GroundTruth], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration, _ = two_boards
    save_calibration(calibration, tmp_path / "calibration.yaml")
    save_captures(calibration, tmp_path / "captures.csv")
    print_calibration(calibration)
    words = [line.split() for line in capsys.readouterr().out.splitlines()]
    table = words[next(i for i, row in enumerate(words) if row[:2] == ["sensor", "predicted"]) :]
    printed = next(int(row[1]) for row in table if row[:1] == [sensor])
    stated = read_yaml(tmp_path / "calibration.yaml")["quality"]["cross_validation"][sensor]["captures"]
    with (tmp_path / "captures.csv").open(encoding="utf-8", newline="") as file:
        listed = {
            row["capture"] for row in csv.DictReader(file) if row["sensor"] == sensor and row["used"] == "yes"
        }
    assert (printed, stated) == (len(listed), len(listed))
