"""Intrinsics of cameras from rig.yaml and recordings, and cameras that have none."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from calgraph.config import CameraSpec, Rig
from calgraph.recording import open_recording, resolve_intrinsics

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
