"""calgraph intrinsics: images of a board in a plain folder, and what reads the result."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from ruamel.yaml import YAML
from typer.testing import Result

from calgraph.config import AprilGrid, Board, CameraSpec, Rig
from calgraph.errors import Rejected
from calgraph.printing import format_target
from calgraph.recording import RecordingCache, open_recording, resolve_intrinsics
from calgraph.rig.intrinsics.pipeline import calibrate_intrinsics
from calgraph.sensors import CameraModel, Image
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    build_world,
)
from calgraph.simulation.robot import MountedCamera
from simulated_captures import simulate_captures

Run = Callable[..., Result]
BOARD = Board(
    size=(1.0, 1.0), pattern=AprilGrid(kind="aprilgrid", columns=3, rows=3, tag_size=0.22, tag_spacing=0.3)
)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CameraModel]:
    """A folder with board.yaml and 12 images of one camera, and the true camera."""
    folder = tmp_path_factory.mktemp("images of a board")
    world = build_world(
        RigScenario(
            camera=CameraOptions(
                width=480, height=360, field_of_view=80, distortion=(-0.2, 0.06, 1e-3, -5e-4), texels_per_mm=1.0
            ),
            laser=LaserOptions(count=0),
            spinning=SpinningOptions(count=0),
            multibeam=MultibeamOptions(count=1, rings=2, rate=10.0, resolution=30.0),
            board=BOARD,
            bearings=(-30, -18, -6, 6, 18, 30),
            radii=(1.2, 1.8),
            samples=1,
            max_rotation=40,
            heights=(0.5, 1.5),
            clutter=0,
        ),
        5,
    )
    images = folder / "recording" / "camera"
    images.mkdir(parents=True)
    for capture in simulate_captures(world):
        (image,) = [message for message in capture.messages["camera"] if isinstance(message, Image)][:1]
        cv2.imwrite(str(images / f"{image.stamp:.6f}.png"), image.gray)
    (folder / "board.yaml").write_text(format_target([BOARD]))
    return folder, next(one.camera for one in world.robot if isinstance(one, MountedCamera))


@pytest.fixture(scope="module")
def estimated(recorded: tuple[Path, CameraModel], run: Run) -> tuple[Path, Result]:
    folder = recorded[0]
    done = run(
        "intrinsics", folder / "board.yaml", folder / "recording", "-o", folder / "out", "--json", "--jobs", 1
    )
    assert done.exit_code == 0, done.stderr
    return folder / "out", done


def test_the_summary_has_the_true_camera(
    recorded: tuple[Path, CameraModel], estimated: tuple[Path, Result]
) -> None:
    content = json.loads(estimated[1].stdout)
    assert content == json.loads((estimated[0] / "intrinsics.json").read_text())
    found, truth = content["cameras"]["camera"], recorded[1]
    assert (found["model"], found["width"], found["height"]) == ("pinhole", 480, 360)
    np.testing.assert_allclose(found["K"][:2], truth.focal, rtol=0.003)
    np.testing.assert_allclose(found["K"][2:], truth.principal_point, atol=1.0)
    assert set(found["stddev"]) == {"fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"}
    assert found["views_used"] >= 10
    assert found["rms"] < 0.2


def test_a_plain_folder_with_the_camera_info_has_these_intrinsics(
    recorded: tuple[Path, CameraModel], estimated: tuple[Path, Result], tmp_path: Path
) -> None:
    shutil.copytree(recorded[0] / "recording", tmp_path / "recording")
    shutil.copy(estimated[0] / "camera" / "camera_info.yaml", tmp_path / "recording" / "camera")
    rig = Rig(root="camera", target=BOARD, sensors={"camera": CameraSpec(topic="camera")})
    with open_recording(tmp_path / "recording") as recording:
        camera = resolve_intrinsics(rig, recording).camera_models()["camera"]
    found = json.loads(estimated[1].stdout)["cameras"]["camera"]
    np.testing.assert_allclose(camera.intrinsics, [*found["K"], *found["distortion"]], rtol=1e-12)


def test_opencv_undistorts_the_board_with_the_camera_info(
    recorded: tuple[Path, CameraModel], estimated: tuple[Path, Result]
) -> None:
    content = YAML(typ="safe").load(estimated[0] / "camera" / "camera_info.yaml")
    K = np.reshape(content["camera_matrix"]["data"], (3, 3))
    D = np.array(content["distortion_coefficients"]["data"])
    pixels = np.array([[[40.0, 30.0]], [[240.0, 180.0]], [[440.0, 330.0]]])
    normalized = cv2.undistortPoints(pixels, K, D)[:, 0]
    rays = recorded[1].rays(pixels[:, 0])
    # Half a pixel.
    np.testing.assert_allclose(normalized, rays[:, :2] / rays[:, 2:], atol=0.5 / recorded[1].K[0, 0])


def test_kalibr_gets_the_nearest_of_its_models(estimated: tuple[Path, Result]) -> None:
    content = YAML(typ="safe").load(estimated[0] / "camera" / "camchain.yaml")["cam0"]
    assert content["distortion_model"] == "radtan"
    assert content["resolution"] == [480, 360]
    assert content["rostopic"] == "camera"
    assert content["distortion_coeffs"][0] == pytest.approx(-0.2, abs=0.01)


def test_images_that_do_not_suffice_end_with_exit_code_1_and_what_to_do(
    recorded: tuple[Path, CameraModel], run: Run, tmp_path: Path
) -> None:
    few = tmp_path / "recording" / "camera"
    few.mkdir(parents=True)
    for image in sorted((recorded[0] / "recording" / "camera").glob("*.png"))[:3]:
        shutil.copy(image, few)
    done = run("intrinsics", recorded[0] / "board.yaml", tmp_path / "recording", "-o", tmp_path / "out")
    assert done.exit_code == 1
    assert "camera: 3 images with at least 8 corners of the board do not determine its intrinsics" in done.stderr
    failure = json.loads((tmp_path / "out" / "intrinsics.json").read_text())["cameras"]["camera"]["failure"]
    assert "tilted by 30 to 45 degrees" in failure


def test_a_camera_that_does_not_exist_is_refused_with_those_that_do(
    recorded: tuple[Path, CameraModel], run: Run, tmp_path: Path
) -> None:
    folder = recorded[0]
    done = run(
        "intrinsics", folder / "board.yaml", folder / "recording", "-o", tmp_path / "out", "--camera", "left"
    )
    assert done.exit_code == 2
    assert "--camera: there is no camera 'left'; there are camera (camera)" in done.stderr


def test_a_second_run_takes_corners_from_the_cache(
    recorded: tuple[Path, CameraModel], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Rig(root="camera", target=BOARD, sensors={"camera": CameraSpec(topic="/camera")})

    def calibrate() -> CameraModel:
        with open_recording(recorded[0] / "recording") as recording:
            topic = next(iter({record.topic for record in recording.records()}))
            spec = CameraSpec(topic=topic)
            found = calibrate_intrinsics(
                rig.model_copy(update={"sensors": {"camera": spec}}), recording, cache=RecordingCache(tmp_path)
            )["camera"]
        assert not isinstance(found, Rejected), found.reason
        return found.camera

    first = calibrate()
    monkeypatch.delattr("calgraph.rig.intrinsics.pipeline.search_holds")
    assert np.array_equal(calibrate().intrinsics, first.intrinsics)
