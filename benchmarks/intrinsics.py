"""Intrinsics from scratch on simulated rigs: their errors, and those of poses against those with true intrinsics.

python benchmarks/intrinsics.py --seeds 20
python benchmarks/intrinsics.py --seeds 20 --warp 0.3    # the lens has terms that no model of ours has

A rig of a camera and a 16-beam LiDAR, and 24 captures of a board with an AprilGrid. Corners have a noise of 0.2
px. Images of 680 by 510 pixels are cropped to 640 by 480, so that the principal point is up to 20 and 15 pixels
from the middle. The warp moves pixels along and across the radius, by two and one periods of a sine over the half
diagonal.

Columns: errors of the focal length, %, and of the principal point, px, RMS and largest, of the views alone and of
the joint solution; NEES per parameter; RMS errors of the camera's pose with true intrinsics and without any; NEES.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.boards.board_pose import BoardPose, fit_pose
from calgraph.boards.camera import make_board_corners
from calgraph.boards.detections import BoardCorners
from calgraph.config import AprilGrid, Board, Rig
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3
from calgraph.result import Calibration
from calgraph.rig.captures.detect import CaptureSet, state_estimated_intrinsics
from calgraph.rig.detection.board_views import BoardView
from calgraph.rig.intrinsics.estimate import estimate_intrinsics
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.sensors import CameraModel
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    World,
    build_world,
    ground_truth,
    world_rig,
)
from calgraph.simulation.robot import MountedCamera
from ideal_detections import IdealDetectorOptions, simulate_detections
from worlds import make_parser

SIZE, MARGIN, NOISE = (640, 480), (40, 30), 0.2
LENSES = {
    "pinhole60": CameraOptions(field_of_view=60, distortion=(-0.1, 0.05, 1e-3, -5e-4, 0.0)),
    "pinhole90": CameraOptions(field_of_view=90, distortion=(-0.25, 0.08, 1e-3, -5e-4, -0.01)),
    "pinhole110": CameraOptions(field_of_view=110, distortion=(-0.2, 0.04, 1e-3, -5e-4, -0.003)),
    "fisheye150": CameraOptions(field_of_view=150, model="fisheye", distortion=(0.03, -0.01, 0.003, -0.001)),
    "fisheye190": CameraOptions(field_of_view=190, model="fisheye", distortion=(-0.02, 0.008, -0.004, 5e-4)),
}
BOARD = Board(
    size=(1.0, 1.0), pattern=AprilGrid(kind="aprilgrid", columns=4, rows=4, tag_size=0.17, tag_spacing=0.3)
)


@dataclass(frozen=True, eq=False)
class Outcome:
    """Errors of one recording."""

    alone: Array
    """(4,) relative errors of fx and fy, and errors of cx and cy (px), of the views alone,"""
    joint: Array
    """(4,) and of the joint solution."""
    nees: float
    """Of all intrinsics, per parameter, of the views alone."""
    pose: Array
    """(6,) error of the camera's pose without intrinsics, m and rad,"""
    pose_given: Array
    """(6,) and with the true ones."""
    pose_nees: float


def main() -> None:
    """Prints a line for each lens."""
    parser = make_parser(__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--warp", type=float, default=0.0, help="largest displacement, px")
    parser.add_argument("--lens", choices=LENSES, action="append")
    arguments = parser.parse_args()
    print(
        f"{'lens':>11} {'n':>3} {'focal %':>13} {'centre px':>13} {'joint %':>13} {'joint px':>13} {'nees':>5} "
        f"{'given mm':>8} {'mm':>6} {'given deg':>9} {'deg':>6} {'nees':>5}"
    )
    for lens in arguments.lens or LENSES:
        seeds = range(arguments.first, arguments.first + arguments.seeds)
        outcomes = [measure(lens, seed, arguments.warp) for seed in seeds]
        _print_row(lens, [one for one in outcomes if one is not None])


def _print_row(lens: str, outcomes: Sequence[Outcome]) -> None:
    alone, joint = (np.abs([getattr(one, name) for one in outcomes]) for name in ("alone", "joint"))
    pose, given = (np.array([getattr(one, name) for one in outcomes]) for name in ("pose", "pose_given"))
    texts = [
        f"{_rms(100 * a[:, :2]):6.3f} {100 * a[:, :2].max():6.3f} {_rms(a[:, 2:]):6.2f} {a[:, 2:].max():6.2f}"
        for a in (alone, joint)
    ]
    print(
        f"{lens:>11} {len(outcomes):3d} {texts[0]} {texts[1]} {np.mean([o.nees for o in outcomes]):5.2f} "
        f"{1000 * _rms(given[:, :3]):8.2f} {1000 * _rms(pose[:, :3]):6.2f} {np.degrees(_rms(given[:, 3:])):9.3f} "
        f"{np.degrees(_rms(pose[:, 3:])):6.3f} {np.mean([o.pose_nees for o in outcomes]):5.2f}",
        flush=True,
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def measure(lens: str, seed: int, warp: float) -> Outcome | None:
    """One recording, with true intrinsics and without any; None if the views do not suffice."""
    world = build_world(_scenario(lens), seed, images=False)
    rig, truth = world_rig(world), ground_truth(world)
    rng = np.random.default_rng([seed, 7])
    shift = np.array([rng.integers(MARGIN[0] + 1), rng.integers(MARGIN[1] + 1)])
    whole = next(one.camera for one in world.robot if isinstance(one, MountedCamera))
    K = whole.K.copy()
    K[:2, 2] -= shift
    camera = CameraModel(whole.model, *SIZE, K, whole.distortion)
    views, collect = _simulate_corners(world, camera, shift, warp, seed)
    given = _calibrate(rig, collect(camera), seed)
    estimate = estimate_intrinsics(rig, "camera", views)
    if isinstance(estimate, Rejected):
        print(f"{lens} {seed}: {estimate.reason}")
        return None
    if estimate.camera.model != camera.model:
        print(f"{lens} {seed}: {estimate.camera.model}, {estimate.rejected_models}")
    captured = collect(estimate.camera)
    captured = replace(captured, estimated_intrinsics={"camera": estimate.to_intrinsics()})
    free = _calibrate(state_estimated_intrinsics(rig, captured), captured, seed)
    intrinsics = free["camera"].intrinsics
    assert intrinsics is not None
    nees = np.nan
    if estimate.camera.model == camera.model:
        error = estimate.camera.intrinsics - camera.intrinsics
        nees = float(error @ np.linalg.solve(estimate.covariance, error)) / len(error)
    pose, reference = (
        se3.difference(c["camera"].T_root_sensor, truth.T_root_sensor["camera"]) for c in (free, given)
    )
    return Outcome(
        alone=_relative(estimate.camera, camera),
        joint=_relative(intrinsics.to_camera(), camera),
        nees=nees,
        pose=pose,
        pose_given=reference,
        pose_nees=float(pose @ np.linalg.solve(free["camera"].covariance, pose) / 6),
    )


def _scenario(lens: str) -> RigScenario:
    options = LENSES[lens].model_copy(update={"width": SIZE[0] + MARGIN[0], "height": SIZE[1] + MARGIN[1]})
    reach = min(0.4 * options.field_of_view, 70.0)
    near = 0.9 if options.field_of_view > 100 else 1.3
    return RigScenario(
        camera=options.model_copy(update={"texels_per_mm": 1.0}),
        laser=LaserOptions(count=0),
        spinning=SpinningOptions(count=0),
        multibeam=MultibeamOptions(count=1, rings=16, resolution=0.8),
        board=BOARD,
        bearings=tuple(np.linspace(-reach, reach, 12)),
        radii=(near, 1.6 * near),
        samples=1,
        max_rotation=40.0,
        heights=(0.5, 1.6),
    )


_Collect = Callable[[CameraModel], CaptureSet]
"""All detections, with the boards located by these intrinsics."""


def _simulate_corners(
    world: World, camera: CameraModel, shift: Array, warp: float, seed: int
) -> tuple[list[BoardView], _Collect]:
    """Views with exact corners but for Gaussian noise, the warp and the crop."""
    _, captured, _ = simulate_detections(world, seed, IdealDetectorOptions(pixel=NOISE))
    views = {}
    for capture, (found,) in captured.detections["camera"].items():
        assert isinstance(found, BoardCorners)
        pixels = found.pixels - shift
        pixels = pixels - _displacement(pixels, warp, camera)
        inside = camera.contains(pixels)
        if inside.sum() >= 8:
            ids = np.arange(int(inside.sum()))
            views[capture] = BoardView(ids, found.corners_board[inside][:, None], pixels[inside][:, None], SIZE)

    def collect(camera: CameraModel) -> CaptureSet:
        located: dict[int, tuple[BoardCorners]] = {}
        rejections = dict(captured.rejections)
        for hold in captured.holds:
            view = views.get(hold.index)
            pose: BoardPose | Rejected = Rejected("outside of the image")
            if view is not None:
                pose = fit_pose(view.ids, view.corners, view.pixels, camera, NOISE)
                if isinstance(pose, BoardPose):
                    located[hold.index] = (make_board_corners(pose, view.corners, view.pixels),)
            if isinstance(pose, Rejected):
                rejections[hold.index, "camera"] = pose.reason
        detections = {**captured.detections, "camera": located}
        return replace(captured, detections=detections, rejections=rejections, cameras={"camera": camera})

    return list(views.values()), collect


def _displacement(pixels: Array, warp: float, camera: CameraModel) -> Array:
    """(..., 2) what a lens has that no model has: two periods along the radius, and one across, px."""
    away = pixels - camera.principal_point
    length = np.linalg.norm(away, axis=-1, keepdims=True)
    radius, away = length / (np.hypot(*SIZE) / 2), away / np.maximum(length, 1e-9)
    across = away[..., ::-1] * [-1, 1]
    return np.asarray(warp * (np.sin(4 * np.pi * radius) * away + 0.5 * np.sin(2 * np.pi * radius) * across))


def _calibrate(rig: Rig, captured: CaptureSet, seed: int) -> Calibration:
    options = RigOptions(folds=0)
    return solve_problem(build_problem_from_captures(rig, captured, options, np.random.default_rng(seed)))


def _relative(camera: CameraModel, truth: CameraModel) -> Array:
    """(4,) relative errors of the focal lengths, and errors of the principal point, px."""
    return np.concatenate([camera.focal / truth.focal - 1, camera.principal_point - truth.principal_point])


if __name__ == "__main__":
    main()
