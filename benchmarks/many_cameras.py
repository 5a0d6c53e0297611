"""A ring of cameras around a board, without intrinsics: time of each step, peak memory, and errors of the poses.

python benchmarks/many_cameras.py
python benchmarks/many_cameras.py --cameras 10 --captures 60 --radius 2.5

Cameras look at the middle of a ring from different heights. The board is turned to another one in each capture, so
that some of its neighbours see it, too. Corners have a noise of 0.2 px; lenses have the distortion of webcams.
Detection in images is not part of it: it grows with the number of images, and runs in as many processes as asked.
"""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from calgraph.boards.board_pose import fit_pose
from calgraph.boards.camera import make_board_corners
from calgraph.boards.detections import Detection
from calgraph.boards.printed_boards import compute_landmarks
from calgraph.config import Rig
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3, so3
from calgraph.parallel.engine import Processes
from calgraph.result import state_intrinsics
from calgraph.rig.captures.from_detections import captures_from_detections
from calgraph.rig.detection.board_views import BoardView
from calgraph.rig.intrinsics.estimate import IntrinsicsEstimate, estimate_intrinsics
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.sensors import CameraModel
from process_costs import measure_cpu, measure_peak_memories
from worlds import make_parser

SIZE = 1280, 960
NOISE = 0.2
"""Of corners, pixels."""
MIN_INCIDENCE = np.cos(np.radians(60))
"""Cosine of the largest angle at which a camera detects the board."""
MIN_CORNERS = 8


def make_rig(cameras: int) -> Rig:
    """The cameras and a ChArUco board of 1.0 x 0.7 m."""
    pattern = {"kind": "charuco", "columns": 10, "rows": 7, "square": 0.1, "marker": 0.075}
    target = {"kind": "board", "size": [1.0, 0.7], "pattern": {**pattern, "dictionary": "DICT_5X5_100"}}
    sensors = {f"camera_{i}": {"kind": "camera", "topic": f"/camera_{i}"} for i in range(cameras)}
    return Rig.model_validate({"root": "camera_0", "target": target, "sensors": sensors})


def look_at(position: Array, target: Array) -> Array:
    """(4, 4) pose of a camera at a position whose optical axis points at a target, with y downwards."""
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return se3.pose(np.column_stack([x, np.cross(z, x), z]), position)


def draw_cameras(count: int, radius: float, rng: np.random.Generator) -> tuple[Array, list[CameraModel]]:
    """Poses (S, 4, 4) in the middle's frame, and lenses."""
    poses, lenses = [], []
    for angle in 2 * np.pi * np.arange(count) / count:
        position = np.array([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-0.8, 0.8)])
        poses.append(look_at(position, rng.uniform(-0.2, 0.2, 3)))
        f, (u, v) = rng.uniform(850, 1000), rng.uniform(-10, 10, 2)
        K = np.array([[f, 0, 639.5 + u], [0, f, 479.5 + v], [0, 0, 1]])
        lenses.append(CameraModel("pinhole", *SIZE, K, np.array([rng.uniform(-0.1, 0.1), 0.02, 0, 0, 0])))
    return np.array(poses), lenses


def view_boards(
    rig: Rig, T_world_camera: Array, lenses: list[CameraModel], captures: int, rng: np.random.Generator
) -> dict[str, dict[int, BoardView]]:
    """By camera and capture, the corners of the board that is turned to one camera after the other."""
    marks = compute_landmarks(rig.boards[0])
    corners = marks.corners[:, 0]
    views: dict[str, dict[int, BoardView]] = {name: {} for name in rig.sensors}
    for k in range(captures):
        center = rng.uniform([-0.5, -0.5, -0.4], [0.5, 0.5, 0.4])
        towards = T_world_camera[k % len(lenses), :3, 3] + rng.normal(size=3) * 0.8
        # The board's z axis points at the camera, its y axis up.
        T = look_at(center, towards) @ se3.pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
        T = T @ se3.pose(so3.exp(np.array([0, 0, rng.normal() * 0.4])), np.zeros(3))
        for name, T_camera, lens in zip(rig.sensors, T_world_camera, lenses, strict=True):
            T_camera_board = se3.inverse(T_camera) @ T
            sight = T_camera_board[:3, 3] / np.linalg.norm(T_camera_board[:3, 3])
            if -sight @ T_camera_board[:3, 2] < MIN_INCIDENCE:
                continue
            pixels = lens.project(se3.apply(T_camera_board, corners)) + NOISE * rng.normal(size=(len(corners), 2))
            inside = lens.contains(pixels)
            if inside.sum() >= MIN_CORNERS:
                views[name][k] = BoardView(marks.ids[inside], marks.corners[inside], pixels[inside, None], SIZE)
    return views


@contextmanager
def timed(step: str) -> Iterator[None]:
    """Prints how long a step takes, the CPU time of its processes, and the peak of memory so far of any one."""
    start, cpu = time.perf_counter(), measure_cpu()
    yield
    seconds, used, peak = time.perf_counter() - start, measure_cpu() - cpu, max(measure_peak_memories())
    print(f"{step:28} {seconds:7.1f} s, CPU {used:6.1f} s, peak {peak:6.0f} MB", flush=True)


def main() -> None:
    """Prints the table."""
    parser = make_parser(__doc__)
    parser.add_argument("--cameras", type=int, default=20)
    parser.add_argument("--captures", type=int, default=95)
    parser.add_argument("--radius", type=float, default=2.5, help="of the ring, m")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)
    rng = np.random.default_rng(arguments.seed)
    rig = make_rig(arguments.cameras)
    T_world_camera, lenses = draw_cameras(arguments.cameras, arguments.radius, rng)
    views = view_boards(rig, T_world_camera, lenses, arguments.captures, rng)
    counts = [len(of) for of in views.values()]
    print(f"{arguments.cameras} cameras, {min(counts)} to {max(counts)} views each, {sum(counts)} in all")
    with timed("intrinsics"):
        work = [(rig, name, list(of.values())) for name, of in views.items()]
        found = dict(zip(views, Processes(arguments.jobs).map(estimate_intrinsics, work), strict=True))
    failed = {name: one.reason for name, one in found.items() if isinstance(one, Rejected)}
    for name, reason in failed.items():
        print(f"{name}: {reason}")
    estimates = {name: one for name, one in found.items() if isinstance(one, IntrinsicsEstimate)}
    stated = {name: state_intrinsics(rig.cameras()[name], one.to_intrinsics()) for name, one in estimates.items()}
    rig = rig.model_copy(update={"sensors": stated})
    detections: dict[str, dict[int, Detection]] = {name: {} for name in estimates}
    for name, one in estimates.items():
        for k, view in views[name].items():
            pose = fit_pose(view.ids, view.corners, view.pixels, one.camera, NOISE)
            if not isinstance(pose, Rejected):
                detections[name][k] = make_board_corners(pose, view.corners, view.pixels)
    captures = captures_from_detections(rig, detections, {name: one.camera for name, one in estimates.items()})
    with timed("pairs and tree"):
        problem = build_problem_from_captures(rig, captures, RigOptions(), np.random.default_rng(0))
    with timed("joint solution and checks"):
        calibration = solve_problem(problem, arguments.jobs)
    T_world_root = T_world_camera[0]
    for sensor in calibration.sensors:
        truth = se3.inverse(T_world_root) @ T_world_camera[list(views).index(sensor.name)]
        e = se3.difference(sensor.T_root_sensor, truth)
        nees = float(e @ np.linalg.pinv(sensor.covariance) @ e / 6)
        print(
            f"{sensor.name:10} {sensor.verdict.grade:12} {1000 * np.linalg.norm(e[:3]):6.2f} mm "
            f"{np.degrees(np.linalg.norm(e[3:])):6.3f}° NEES {nees:5.2f}"
        )
    for name, reason in calibration.evidence.unconnected.items():
        print(f"{name}: no pose: {reason}")


if __name__ == "__main__":
    main()
