"""Subsets of the real VLP-16 recording against each other: are stated standard deviations right?

python benchmarks/subsets.py                        # k = 8, 11, 12, 16, 20, 24 captures, 40 random draws each
python benchmarks/subsets.py --k 8 16 --draws 20 --jobs 4
python benchmarks/subsets.py --corrections          # points as published, and corrected, from the camera's planes
python benchmarks/subsets.py --more --draws 12      # the remedy of as many captures again, and what these give

Data: acfr-vlp16-checkerboard in ../shared/data, or in CALGRAPH_DATA; all 40 captures. The board is
detected in whole sweeps, with up to eight candidates a sweep, as no background was recorded.

Poses from k captures are compared with those from all other captures: M is the squared Mahalanobis distance, of
six degrees of freedom, without the covariance that both share through the priors of systematic parameters. Held
out: the camera of the k captures locates the board in each of the others; RMS over views of the mean distance of
the LiDAR's points from its plane.
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from calgraph.boards.detections import BoardCorners, Detection, DetectionResult, PlanePatch
from calgraph.boards.printed_boards import compute_landmarks
from calgraph.config import Rig, Tolerance
from calgraph.errors import Rejected
from calgraph.geometry import Array, plane, se3
from calgraph.recording import open_recording
from calgraph.result import Calibration, apply_estimates
from calgraph.rig.bundle.observations import relative_poses
from calgraph.rig.captures.detectors import draw_seeds, make_detectors
from calgraph.rig.captures.from_detections import captures_from_detections
from calgraph.rig.detection.from_measurements import board_corners_from_pixels
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import calibrate_detections
from calgraph.sensors import PointCloud
from calgraph.sensors.kinds import KINDS
from real_fits import Fit, apply_systematic, cross_covariance, fit_captures, locate_boards
from real_recordings import DATA, VLP16
from worlds import NAN, grouped, make_parser, median, rms, run_worlds

CAPTURES = range(1, 41)
BEYOND = float(chi2.ppf(0.99, 6))
NO_WEIGHT = 1e6
"""Times the stated noise: the LiDAR does not move the boards that the camera locates."""
MAX_DISTANCE = 0.1
"""Mean distance of points from the plane of the board beyond which they are of something else, m."""
BOARD_STEPS = 3
"""Gauss-Newton steps that locate a board from one camera; they start from the pose by both sensors."""


@dataclass(frozen=True)
class Draw:
    """One random set of captures against the others."""

    k: int
    draw: int
    found: bool
    grade: str = ""
    squared: float = NAN
    """Squared Mahalanobis distance."""
    distance: float = NAN
    """Between the two translations, m."""
    stddev: float = NAN
    """Largest stated standard deviation of the k captures' translation, m."""
    held_out: float = NAN
    """RMS of views' mean distances from the predicted plane, m."""


def data_folder() -> Path:
    """Where the recording is."""
    return DATA / "acfr-vlp16-checkerboard"


@functools.cache
def load() -> tuple[Rig, Mapping[str, Mapping[int, DetectionResult | Detection]]]:
    """The rig, and all detections by sensor and capture."""
    rig = Rig.model_validate(VLP16)
    seeds = draw_seeds(rig, np.random.default_rng(0))
    detect = make_detectors(rig, rig.camera_models(), {}, None, seeds)["lidar"]
    with open_recording(data_folder()) as recording:
        decoded = (record.decode() for record in recording.records([rig.topics["lidar"]]))
        clouds = [message for message in decoded if isinstance(message, PointCloud)]
        patches = {pose: detect([cloud]) for pose, cloud in zip(CAPTURES, clouds, strict=True)}
    return rig, {"camera": read_corners(rig), "lidar": patches}


def read_corners(rig: Rig) -> dict[int, BoardCorners]:
    """The printed corners in all images, from the recording's table."""
    printed = compute_landmarks(rig.boards[0]).corners[:, 0]
    camera = rig.camera_models()["camera"]
    rows = np.genfromtxt(data_folder() / "corners_all40.csv", delimiter=",", skip_header=1)
    found = {}
    for pose in CAPTURES:
        # Rows of five corners, along the shorter side of the board.
        lattice = rows[rows[:, 0] == pose, 2:].reshape(7, 5, 2).swapaxes(0, 1)
        right, down = (lattice[:, -1] - lattice[:, 0]).mean(axis=0), (lattice[-1] - lattice[0]).mean(axis=0)
        if right[0] * down[1] < right[1] * down[0]:
            lattice, down = lattice[::-1], -down
        # The print equals itself turned by 180 degrees.
        lattice = lattice if down[1] > 0 else lattice[::-1, ::-1]
        corners = board_corners_from_pixels(printed, lattice.reshape(-1, 2), camera)
        assert not isinstance(corners, Rejected)
        found[pose] = corners
    return found


def select_captures(chosen: Sequence[int]) -> dict[str, dict[int, DetectionResult | Detection]]:
    """The detections of some captures."""
    return {name: {capture: found[capture] for capture in chosen} for name, found in load()[1].items()}


def fit_chosen(chosen: Sequence[int]) -> Fit | None:
    """Calibrates from some captures; None if the camera is lost."""
    rig, _ = load()
    fit = fit_captures(rig, captures_from_detections(rig, select_captures(chosen)))
    return None if fit.joint.solved_bundle is None else fit


def compare_draw(k: int, draw: int) -> Draw:
    """One random draw of captures against all others; the same for the same arguments."""
    chosen = sorted(np.random.default_rng([k, draw]).choice(CAPTURES, k, replace=False).tolist())
    fit, other = fit_chosen(chosen), fit_chosen(sorted(set(CAPTURES) - set(chosen)))
    if fit is None or other is None:
        return Draw(k, draw, found=False)
    error = se3.difference(fit.joint.T_root_sensor["camera"], other.joint.T_root_sensor["camera"])
    P_a, P_b = fit.joint.covariance["camera"], other.joint.covariance["camera"]
    cross = cross_covariance(fit.joint, other.joint, "camera")
    return Draw(
        k,
        draw,
        True,
        fit.calibration["camera"].verdict.grade,
        float(error @ np.linalg.solve(P_a + P_b - cross - cross.T, error)),
        float(np.linalg.norm(error[:3])),
        float(np.sqrt(np.diag(P_a)[:3].max())),
        predict_planes(fit, other),
    )


def predict_planes(fit: Fit, held_out: Fit) -> float:
    """RMS over held-out views of the mean distance of the LiDAR's points from the plane by the camera, m."""
    solved, other = fit.joint.solved_bundle, held_out.joint.solved_bundle
    assert solved is not None
    assert other is not None
    bundle = other.bundle
    state = apply_systematic(solved, bundle, other.minimized.state)
    state = replace(state, T_root_sensor=np.array([fit.joint.T_root_sensor[name] for name in bundle.sensors]))
    bundle = bundle.without_outlines()
    camera, lidar = bundle.sensors.index("camera"), bundle.sensors.index("lidar")
    beams: Any = bundle.views[lidar]
    T_lidar_board = relative_poses(state.T_root_sensor[lidar], state.T_root_board[beams.board])
    by_camera = bundle.with_views(
        [v if s == camera else v.update_noise(T_lidar_board, NO_WEIGHT) for s, v in enumerate(bundle.views)]
    )
    state = locate_boards(by_camera, state, np.unique(bundle.views[camera].board), BOARD_STEPS)
    T_lidar_board = relative_poses(state.T_root_sensor[lidar], state.T_root_board[beams.board])
    residual = beams.linearize(T_lidar_board, state.extra[bundle.extra_indices(lidar)]).residual[:, 0]
    count = np.diff(beams.start, append=len(residual))
    normal = np.repeat(T_lidar_board[:, :3, 2], count, axis=0)
    distance = residual * beams.sigma * np.sum(normal * beams.directions, axis=1)
    means = np.add.reduceat(distance, beams.start) / count
    return float(np.sqrt(np.mean(means**2)))


def show_subsets(draws: Sequence[Draw]) -> None:
    """Prints a line for each number of captures."""
    print("   k  lost  good  median M/6: all, good  mean M/6: all, good  beyond 99 % of good  ", end="")
    print("held out, mm  apart, mm  stated, mm")
    for k, of_size in grouped(draws, lambda one: one.k):
        kept = [one for one in of_size if one.found]
        squared = np.array([one.squared for one in kept])
        good = np.array([one.grade == "good" for one in kept], dtype=np.bool_)
        of_good = squared[good] if good.any() else np.array([np.nan])
        print(
            f"{k:4d} {len(of_size) - len(kept):5d} {good.sum():5d} {np.median(squared) / 6:12.2f} "
            f"{np.median(of_good) / 6:9.2f} {squared.mean() / 6:13.2f} {of_good.mean() / 6:9.2f} "
            f"{np.mean(of_good > BEYOND):14.0%} {'':5} "
            f"{1000 * rms([one.held_out for one in kept]):12.2f} "
            f"{1000 * median([one.distance for one in kept]):10.1f} "
            f"{1000 * median([one.stddev for one in kept]):11.1f}",
            flush=True,
        )


def show_corrections() -> None:
    """Prints distances of the LiDAR's points from the boards by the camera, as published and corrected."""
    every, odd, even = CAPTURES, CAPTURES[::2], CAPTURES[1::2]
    cases = ("all, fitted", every, every), ("even, held out", odd, even), ("odd, held out", even, odd)
    for label, fitted, judged in cases:
        calibration = calibrate_detections(load()[0], select_captures(fitted), RigOptions())
        published, corrected = [], []
        for capture in judged:
            if (beams := find_beams(calibration, capture)) is not None:
                plane_of_board, points = beams
                published.append(plane.distance(plane_of_board, points))
                corrected.append(plane.distance(plane_of_board, calibration.correct("lidar", points)))
        shown = (
            f"{1000 * rms(np.concatenate(parts)):5.1f} mm, means {1000 * rms([p.mean() for p in parts]):5.1f} mm"
            for parts in (published, corrected)
        )
        print(f"{label:15} {len(published)} views: RMS by pose alone {', corrected '.join(shown)}", flush=True)


def show_more_captures(draws: int) -> None:
    """Prints standard deviations with k further captures, over those that the remedy of the first k predicts."""
    rig = load()[0].model_copy(update={"tolerance": Tolerance(translation=0.001, rotation=0.03)})
    for k in (10, 14, 20):
        ratios = []
        for draw in range(draws):
            order = np.random.default_rng([k, draw]).permutation(list(CAPTURES)).tolist()
            few, more = (
                calibrate_detections(rig, select_captures(sorted(order[:count])), RigOptions(folds=0))
                for count in (k, 2 * k)
            )
            for one in few.evidence.remedies:
                if (
                    one.captures == k
                    and not one.uncertainty
                    and "camera" in [sensor.name for sensor in more.sensors]
                ):
                    axis = KINDS["camera"].axes.index(one.axis)
                    ratios.append(float(more["camera"].axis_stddev[axis]) / one.expected)
        low, high = np.quantile(ratios, [0.05, 0.95])
        print(
            f"{k} more after {k}: {len(ratios)} draws, obtained/predicted median {median(ratios):.2f}, "
            f"5 to 95 % {low:.2f} to {high:.2f}",
            flush=True,
        )


def find_beams(calibration: Calibration, capture: int) -> tuple[Array, Array] | None:
    """The board's plane (4,) by the camera, and the LiDAR's points (N, 3) on it; None where it has none there."""
    rig, found = load()
    corners, patches = found["camera"][capture], found["lidar"][capture]
    camera = apply_estimates(calibration.systematic, "camera", rig.camera_models()["camera"])
    printed = {one.quantity: one.value for one in calibration.systematic if one.of == "board"}
    stretch = printed["print scale"] * (1 + (printed["print aspect"] - 1) * np.array([0.5, -0.5, 0.0]))
    assert isinstance(corners, BoardCorners)
    board = board_corners_from_pixels(corners.corners_board * stretch, corners.pixels, camera)
    assert not isinstance(board, Rejected)
    T = calibration["camera"].T_root_sensor @ board.T_camera_board
    of_board = np.append(T[:3, 2], -T[:3, 2] @ T[:3, 3])
    candidates = patches if isinstance(patches, list | tuple) else [patches]
    off = [one.ranges[:, None] * one.directions for one in candidates if isinstance(one, PlanePatch)]
    points = min(off, key=lambda one: float(np.abs(plane.distance(of_board, one)).mean()), default=None)
    far = points is None or np.abs(plane.distance(of_board, points)).mean() > MAX_DISTANCE
    return None if points is None or far else (of_board, points)


def main() -> None:
    """Prints the tables."""
    parser = make_parser(__doc__, jobs=1)
    parser.add_argument("--k", type=int, nargs="+", default=[8, 11, 12, 16, 20, 24])
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--corrections", action="store_true", help="points as published and corrected instead")
    parser.add_argument("--more", action="store_true", help="as many captures again instead")
    arguments = parser.parse_args()
    load()  # before processes are forked
    if arguments.corrections:
        show_corrections()
    elif arguments.more:
        show_more_captures(arguments.draws)
    else:
        draws = [(k, draw) for k in arguments.k for draw in range(arguments.draws)]
        show_subsets(run_worlds(Draw, compare_draw, draws, arguments, key=2))


if __name__ == "__main__":
    main()
