"""Intrinsics from real corners: calgraph and OpenCV on the same views, and held-out reprojection errors.

python benchmarks/intrinsics_real.py

Data, in ../shared/data or in CALGRAPH_DATA: acfr-vlp16-checkerboard (corners of a checkerboard in 40 images of a
wide fisheye) and four-webcams-charuco-corners (of a board moved by hand). Cameras are estimated from the even
views, and boards located by them in the odd ones: RMS of their reprojection errors, px. OpenCV has the same views
and model (its fisheye starts from calgraph's camera, as it does not converge otherwise); the published camera is
that of the data.
"""

import csv
import tomllib
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from ruamel.yaml import YAML

from calgraph.boards.board_pose import fit_pose
from calgraph.config import Rig
from calgraph.errors import Rejected
from calgraph.recording.camera_info import camera_from_yaml
from calgraph.rig.detection.board_views import BoardView
from calgraph.rig.intrinsics.estimate import IntrinsicsEstimate, estimate_intrinsics
from calgraph.sensors import CameraModel
from real_recordings import DATA

WEBCAM_SQUARE = 0.054


def main() -> None:
    """Prints a line for each camera."""
    print(
        f"{'camera':>10} {'views':>5} {'model':>8} {'fx':>8} {'±':>5} {'cx':>7} {'±':>5} {'cy':>7} {'±':>5} "
        f"{'rms':>5} "
        f"{'held out':>8} {'opencv':>7} {'publ.':>6} {'fx opencv':>9} {'fx publ.':>8}"
    )
    _compare("acfr", *read_acfr())
    for number in range(4):
        _compare(f"webcam {number}", *read_webcam(number))


def _compare(name: str, rig: Rig, views: Sequence[BoardView], published: CameraModel) -> None:
    even, odd = views[::2], views[1::2]
    found = estimate_intrinsics(rig, "camera", even)
    if isinstance(found, Rejected):
        print(f"{name:>10} {len(even):5d} {found.reason}")
        return
    reference = _calibrate_opencv(even, found)
    camera, stddev = found.camera, found.stddev
    errors = [_held_out_error(odd, one) for one in (camera, reference, published)]
    print(
        f"{name:>10} {len(found.detections):5d} {camera.model:>8} {camera.focal[0]:8.2f} {stddev[0]:5.2f} "
        f"{camera.principal_point[0]:7.2f} {stddev[2]:5.2f} {camera.principal_point[1]:7.2f} {stddev[3]:5.2f} "
        f"{found.noise:5.2f} {errors[0]:8.3f} {errors[1]:7.3f} {errors[2]:6.3f} {reference.focal[0]:9.2f} "
        f"{published.focal[0]:8.2f}",
        flush=True,
    )


def _calibrate_opencv(views: Sequence[BoardView], found: IntrinsicsEstimate) -> CameraModel:
    size, camera = views[0].size, found.camera
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 300, 1e-10)
    if camera.model == "pinhole":
        corners = [view.flat_corners.astype(np.float32) for view in views]
        pixels = [view.flat_pixels.astype(np.float32) for view in views]
        _, K, D, _, _ = cv2.calibrateCamera(corners, pixels, size, np.eye(3), np.zeros(5), criteria=criteria)
    else:
        flags = (
            cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC
            + cv2.fisheye.CALIB_FIX_SKEW
            + cv2.fisheye.CALIB_USE_INTRINSIC_GUESS
        )
        _, K, D, _, _ = cv2.fisheye.calibrate(
            [view.flat_corners[None] for view in views], [view.flat_pixels[None] for view in views], size,
            camera.K.copy(), camera.distortion[:, None].copy(), flags=flags, criteria=criteria,
        )  # fmt: skip
    return CameraModel(camera.model, *size, np.asarray(K, dtype=np.float64), np.ravel(D).astype(np.float64))


def _held_out_error(views: Sequence[BoardView], camera: CameraModel) -> float:
    """RMS over all corners of the views, px, whose boards are located by them."""
    squares: list[float] = []
    for view in views:
        pose = fit_pose(view.ids, view.corners, view.pixels, camera, 1.0)
        if not isinstance(pose, Rejected):
            squares += [pose.rms**2] * int(pose.inliers.sum())
    return float(np.sqrt(np.mean(squares)))


def _rig(pattern: Mapping[str, object], size: tuple[float, float]) -> Rig:
    return Rig.model_validate({
        "root": "camera",
        "target": {"kind": "board", "size": size, "pattern": pattern},
        "sensors": {"camera": {"kind": "camera", "topic": "/image"}},
    })  # fmt: skip


def read_acfr() -> tuple[Rig, list[BoardView], CameraModel]:
    """Rig, views and published intrinsics of the wide fisheye."""
    folder = DATA / "acfr-vlp16-checkerboard"
    camera = camera_from_yaml(YAML(typ="safe").load(folder / "camera_info_first_commit.yaml"))
    rows = np.loadtxt(folder / "corners_all40.csv", delimiter=",", skiprows=1)
    # 5 columns of 7 rows; the first corner is at either end: one view does not distinguish them.
    index = np.arange(35)
    corners = np.stack([(index % 5 - 2) * 0.095, -(index // 5 - 3) * 0.095, np.zeros(35)], axis=-1)
    views = []
    for pose in np.unique(rows[:, 0]):
        pixels = rows[rows[:, 0] == pose, 2:]
        views.append(
            BoardView(index, _face(corners, pixels)[:, None], pixels[:, None], (camera.width, camera.height))
        )
    pattern = {"kind": "checkerboard", "columns": 5, "rows": 7, "square": 0.095}
    return _rig(pattern, (0.61, 0.85)), views, camera


def read_webcam(number: int) -> tuple[Rig, list[BoardView], CameraModel]:
    """Rig, views and published intrinsics of one of the webcams."""
    folder = DATA / "four-webcams-charuco-corners"
    stated = tomllib.loads((folder / "camera_array.toml").read_text())["cameras"][str(number)]
    width, height = stated["size"]
    camera = CameraModel("pinhole", width, height, np.array(stated["matrix"]), np.array(stated["distortions"]))
    with (folder / "xy.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if int(row["cam_id"]) == number]
    frames: dict[int, list[dict[str, str]]] = {}
    for row in rows:
        frames.setdefault(int(row["sync_index"]), []).append(row)
    views = []
    for _, found in sorted(frames.items()):
        places = np.array([[float(row["obj_loc_x"]), -float(row["obj_loc_y"]), 0.0] for row in found])
        pixels = np.array([[float(row["img_loc_x"]), float(row["img_loc_y"])] for row in found])
        ids = np.array([int(row["keypoint_id"]) for row in found])
        views.append(BoardView(ids, _face(places, pixels)[:, None], pixels[:, None], (width, height)))
    pattern = {
        "kind": "charuco", "columns": 4, "rows": 5, "square": WEBCAM_SQUARE, "marker": 0.04,
        "dictionary": "DICT_4X4_1000",
    }  # fmt: skip
    return _rig(pattern, (0.5, 0.4)), [view for view in views if len(view.ids) >= 8], camera


def _face(corners: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """The corners as a reader of the print has them: mirrored where the image shows its other side."""
    A = np.column_stack([corners[:, :2], np.ones(len(corners))])
    front = np.linalg.det(np.linalg.lstsq(A, pixels, rcond=None)[0][:2]) < 0
    return corners if front else corners * [-1.0, 1.0, 1.0]


if __name__ == "__main__":
    main()
