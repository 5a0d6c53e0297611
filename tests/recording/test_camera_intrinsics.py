"""Intrinsics of cameras from rig.yaml and recordings, and cameras that have none."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from calgraph.config import CameraSpec, Rig
from calgraph.errors import RecordingError
from calgraph.recording import find_topics, inspect_recording, open_recording, resolve_intrinsics
from calgraph.sensors import CameraInfo, CameraModel

PATTERN = {"kind": "checkerboard", "columns": 5, "rows": 4, "square": 0.1}
RIG = Rig.model_validate({
    "root": "camera",
    "target": {"kind": "board", "size": [1, 1], "pattern": PATTERN},
    "sensors": {"camera": {"kind": "camera", "topic": "camera"}},
})  # fmt: skip


def record(folder: Path, info: str | None) -> Path:
    (folder / "camera").mkdir(parents=True)
    cv2.imwrite(str(folder / "camera" / "1.5.png"), np.zeros((24, 32), dtype=np.uint8))
    if info is not None:
        (folder / "camera" / "camera_info.yaml").write_text(info)
    return folder


def resolve(folder: Path, **keys: object) -> CameraSpec:
    spec = CameraSpec.model_validate({**RIG.sensors["camera"].model_dump(exclude_none=True), **keys})
    with open_recording(folder) as recording:
        return resolve_intrinsics(RIG.model_copy(update={"sensors": {"camera": spec}}), recording).cameras()[
            "camera"
        ]


INFO = "{width: 32, height: 24, K: [30, 0, 15, 0, 30, 11, 0, 0, 1], D: [], distortion_model: plumb_bob}"
ZEROS = "{width: 0, height: 0, K: [0, 0, 0, 0, 0, 0, 0, 0, 0], D: [], distortion_model: ''}"


def test_intrinsics_are_those_beside_the_images(tmp_path: Path) -> None:
    spec = resolve(record(tmp_path, INFO))
    assert spec.stated_intrinsics is not None
    assert spec.stated_intrinsics.K == (30, 30, 15, 11)
    assert spec.stated_intrinsics.estimated_from_views is None


@pytest.mark.parametrize("info", [None, ZEROS], ids=["no file", "zeros"])
def test_a_camera_without_intrinsics_stays_without(tmp_path: Path, info: str | None) -> None:
    assert resolve(record(tmp_path, info)).intrinsics is None


def test_estimate_goes_before_what_is_recorded(tmp_path: Path) -> None:
    spec = resolve(record(tmp_path, INFO), intrinsics="estimate fisheye")
    assert spec.stated_intrinsics is None
    assert spec.lens_to_estimate == "fisheye"


D5 = np.array([0.1, -0.2, 0.001, 0.002, 0.03])
K = np.array([[30.0, 0, 15], [0, 31, 11], [0, 0, 1]])


def read_info(folder: Path, name: str = "camera_info.yaml") -> CameraModel:
    (folder / "camera" / name).touch()
    with open_recording(folder) as recording:
        (record,) = recording.records(["camera/camera_info"])
        message = record.decode()
    assert isinstance(message, CameraInfo)
    return message.camera


@pytest.mark.parametrize("name", ["camera_info.yaml", "camera_info.yml", "intrinsics.yml", "intrinsics.yaml"])
@pytest.mark.parametrize(
    "keys",
    [
        ("image_width", "image_height", "camera_matrix", "distortion_coefficients"),
        ("image_Width", "image_Height", "Camera_Matrix", "Distortion_Coefficients"),
        ("width", "height", "cameraMatrix", "distCoeffs"),
        (None, None, "M1", "D1"),
        (None, None, "mtx", "dist"),
        (None, None, "camera_matrix", "dist_coeffs"),
    ],
)
def test_intrinsics_that_opencv_wrote_are_read(tmp_path: Path, keys: tuple[str, ...], name: str) -> None:
    """Those without the size of the images are of the size of the first of them, 32 x 24."""
    record(tmp_path, None)
    file = cv2.FileStorage(str(tmp_path / "camera" / name), cv2.FILE_STORAGE_WRITE)
    for key, value in zip(keys, (32, 24, K, D5.reshape(5, 1)), strict=True):
        if key:
            file.write(key, value)  # type: ignore[call-overload]
    file.release()
    camera = read_info(tmp_path, name)
    assert (camera.model, camera.width, camera.height) == ("pinhole", 32, 24)
    np.testing.assert_allclose(camera.K, K)
    np.testing.assert_allclose(camera.distortion, D5)


def test_files_of_older_opencv_lack_the_start_of_the_document(tmp_path: Path) -> None:
    record(tmp_path, "%YAML:1.0\n" + INFO)
    assert read_info(tmp_path).width == 32


def test_a_fisheye_of_opencvs_sample_is_one(tmp_path: Path) -> None:
    record(tmp_path, "{width: 32, height: 24, fisheye_model: 1, K: [30, 30, 15, 11], D: [0.1, 0, 0, 0]}")
    assert read_info(tmp_path).model == "fisheye"


def test_the_matrices_of_two_cameras_are_refused(tmp_path: Path) -> None:
    record(tmp_path, "{M1: [30, 30, 15, 11], M2: [30, 30, 15, 11]}")
    with pytest.raises(RecordingError, match="two cameras, M1 and M2: leave those of this camera in its file"):
        read_info(tmp_path)


Record = Callable[..., Path]


def record_infos(ros: SimpleNamespace, make_bag: Record, zeros: int, valid: int) -> Path:
    infos = [ros.camera_info(header=ros.header(k / 10)) for k in range(zeros + valid)]
    for info in infos[:zeros]:
        info.k, info.d, info.width, info.height = np.zeros(9), np.zeros(0), 0, 0
    return make_bag(*(("/cam/camera_info", info, k / 10) for k, info in enumerate(infos)))


def resolve_bag(path: Path) -> CameraSpec:
    spec = CameraSpec(topic="/cam/image_raw", camera_info="/cam/camera_info")
    with open_recording(path) as recording:
        rig = RIG.model_copy(update={"sensors": {"camera": spec}})
        return resolve_intrinsics(rig, recording).cameras()["camera"]


@pytest.mark.parametrize("zeros", [1, 2, 50])
def test_zeros_before_a_calibration_is_loaded_do_not_count(
    ros: SimpleNamespace, make_bag: Record, zeros: int
) -> None:
    path = record_infos(ros, make_bag, zeros, 10)
    found = resolve_bag(path).stated_intrinsics
    assert found is not None
    assert found.K == (500, 510, 320, 240)
    with open_recording(path) as recording:
        (topic,) = find_topics(recording)
        (report,) = inspect_recording(recording, lambda _: None).topics
    assert topic.problem == ""
    which = "message" if zeros == 1 else f"{zeros} messages"
    (finding,) = (finding for finding in report.findings if "cannot be used" in finding)
    assert finding.startswith(f"the first {which} cannot be used, later ones are used: K has no focal lengths")
    assert report.content == "pinhole, 640 x 480, 5 distortion coefficients"


def test_a_camera_that_is_never_calibrated_stays_without_intrinsics(
    ros: SimpleNamespace, make_bag: Record
) -> None:
    path = record_infos(ros, make_bag, 20, 0)
    assert resolve_bag(path).intrinsics is None
    with open_recording(path) as recording:
        (topic,) = find_topics(recording)
    assert topic.problem.startswith("K has no focal lengths")


@pytest.mark.parametrize("name", ["", "plumb_bob", "equidistant", "inverse_brown_conrady", "double_sphere"])
@pytest.mark.parametrize("size", [0, 4, 5, 8, 12, 14])
def test_no_distortion_is_none_under_any_name(
    ros: SimpleNamespace, decoded: Callable[..., CameraInfo], name: str, size: int
) -> None:
    camera = decoded(ros.camera_info(distortion_model=name, d=np.zeros(size))).camera
    assert (camera.model, camera.distortion.size) == ("pinhole", 0)
