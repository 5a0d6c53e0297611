"""Four webcams around a board moved by hand: calgraph against least squares, the published answer, and halves.

python benchmarks/webcams.py
python benchmarks/webcams.py --unstamped    # as if the frames of one index were of one time

Data: four-webcams-charuco-corners in ../shared/data, or in CALGRAPH_DATA: corners in 48 synchronized
frames of a board that never rests; camera 1 faces the mirrored print on its back. Each frame is one capture. Plain
least squares has the same corners, fixed intrinsics, a board without thickness, and equal weights. Each half is
calibrated by itself: odd frames, and even ones, are 0.34 s apart.

Deviations are in the standard deviations that calgraph states: of the largest of six axes, and of the Mahalanobis
distance (the root of M/6). Halves are compared with each other, without the covariance that both share through the
priors of systematic parameters. Held out: cameras of one half, boards of the other half located by all of its
corners; RMS of their reprojection errors.
"""

import logging
import time
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix

from calgraph.boards.detections import BoardCorners, Detection
from calgraph.config import Rig
from calgraph.geometry import Array, se3
from calgraph.recording import open_recording
from calgraph.rig.bundle.board_observations import BoardObservation
from calgraph.rig.bundle.bundle_setup import build_bundle
from calgraph.rig.bundle.bundle_solver import Bundle, BundleState
from calgraph.rig.bundle.observations import relative_poses
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.captures.detectors import draw_seeds, make_detectors
from calgraph.rig.captures.from_detections import captures_from_detections
from calgraph.sensors import CameraModel
from real_fits import Fit, apply_systematic, cross_covariance, fit_captures, locate_boards
from real_recordings import DATA
from worlds import make_parser

ROOT = "camera_1"
SQUARE = 0.054
BOARD_STEPS = 4
"""Gauss-Newton steps that locate a board from cameras with fixed poses; they start from one camera's PnP."""


def data_folder() -> Path:
    """Where the corners are."""
    return DATA / "four-webcams-charuco-corners"


def read_cameras() -> Mapping[str, Mapping[str, Any]]:
    """Intrinsics and published extrinsics by camera."""
    with (data_folder() / "camera_array.toml").open("rb") as file:
        cameras = tomllib.load(file)["cameras"]
    return {f"camera_{number}": camera for number, camera in cameras.items()}


def read_rig() -> Rig:
    """The cameras with their published intrinsics; the first one is the camera nearest to the published origin."""
    sensors = {
        name: {
            "kind": "camera",
            "topic": name.replace("camera", "cam"),
            "intrinsics": {
                "model": "pinhole",
                "width": camera["size"][0],
                "height": camera["size"][1],
                "K": [camera["matrix"][row][column] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2))],
                "distortion": camera["distortions"],
            },
        }
        for name, camera in read_cameras().items()
    }
    pattern = {"kind": "charuco", "columns": 4, "rows": 5, "square": SQUARE, "marker": 0.75 * SQUARE}
    target = {"kind": "board", "size": [0.216, 0.279], "pattern": {**pattern, "dictionary": "DICT_4X4_1000"}}
    return Rig.model_validate({"root": ROOT, "target": target, "sensors": sensors})


@dataclass(frozen=True, eq=False)
class Frames:
    """The corners of all cameras, as measured."""

    rig: Rig
    found: Mapping[str, Mapping[int, Detection]]
    """By camera and frame."""
    times: Mapping[str, Mapping[int, float]] | None
    """When each camera measured it, s; None as if those of one frame were of one time."""

    def __iter__(self) -> Iterator[int]:
        """The frames in which a camera detected the board, in ascending order."""
        return iter(sorted({frame for found in self.found.values() for frame in found}))

    def select(self, frames: Sequence[int]) -> "Frames":
        """Some of the frames."""
        found = {name: {f: one[f] for f in frames if f in one} for name, one in self.found.items()}
        times = self.times and {name: {f: one[f] for f in frames if f in one} for name, one in self.times.items()}
        return Frames(self.rig, found, times)

    def captures(self) -> CaptureSet:
        """The corners at the mean of the stamps of each frame."""
        return captures_from_detections(self.rig, self.found, stamps=self.times)


def read_frames(rig: Rig, *, stamps: bool = True) -> Frames:
    """All frames, with their stamps if ``stamps``."""
    detect = make_detectors(rig, rig.camera_models(), {}, None, draw_seeds(rig, np.random.default_rng(0)))
    found: dict[str, dict[int, Detection]] = {name: {} for name in rig.sensors}
    times: dict[str, dict[int, float]] = {name: {} for name in rig.sensors}
    with open_recording(data_folder()) as recording:
        for name, topic in rig.topics.items():
            for frame, record in enumerate(recording.records([topic])):
                detections = detect[name]([record.decode()])
                times[name][frame] = record.stamp
                if isinstance(detections, tuple) and isinstance(corners := detections[0], BoardCorners):
                    found[name][frame] = corners
    return Frames(rig, found, times if stamps else None)


def published_poses(rig: Rig) -> dict[str, Array]:
    """``T_root_camera`` by camera."""
    T_camera_world = {
        name: se3.pose(np.array(camera["rotation"]), np.array(camera["translation"]))
        for name, camera in read_cameras().items()
    }
    return {name: T_camera_world[rig.root] @ se3.inverse(T_camera_world[name]) for name in rig.sensors}


def fit_by_least_squares(rig: Rig, captures: CaptureSet, start: Mapping[str, Array]) -> dict[str, Array]:
    """``T_root_camera`` by plain least squares over all corners, cameras and boards."""
    names = [name for name in start if name != rig.root]
    bundle, state, frames = bundle_of_all(rig, captures, start)
    boards = dict(zip(frames, locate_all(bundle, state).T_root_board, strict=True))
    column = {name: 6 * i for i, name in enumerate(names)}
    views = [
        (name, i, found)
        for i, capture in enumerate(boards)
        for name in start
        for found in captures.detections[name].get(capture, ())[:1]
        if isinstance(found, BoardCorners)
    ]
    T_boards = list(boards.values())

    def residuals(x: Array) -> Array:
        errors = []
        for name, i, found in views:
            T_root_camera = start[name]
            if name in column:
                T_root_camera = se3.retract(T_root_camera, x[column[name] : column[name] + 6])
            at = 6 * (len(names) + i)
            T_camera_board = se3.inverse(T_root_camera) @ se3.retract(T_boards[i], x[at : at + 6])
            camera: CameraModel = captures.cameras[name]
            errors.append(camera.project(se3.apply(T_camera_board, found.corners_board)) - found.pixels)
        return np.concatenate(errors).ravel()

    unknowns = 6 * (len(names) + len(boards))
    pattern = lil_matrix((2 * sum(len(found.pixels) for _, _, found in views), unknowns), dtype=int)
    row = 0
    for name, i, found in views:
        rows = slice(row, row + 2 * len(found.pixels))
        row = rows.stop
        pattern[rows, 6 * (len(names) + i) : 6 * (len(names) + i) + 6] = 1
        if name in column:
            pattern[rows, column[name] : column[name] + 6] = 1
    found = least_squares(residuals, np.zeros(unknowns), jac_sparsity=pattern, x_scale="jac")
    return {
        name: se3.retract(T, found.x[column[name] : column[name] + 6]) if name in column else T
        for name, T in start.items()
    }


def bundle_of_all(
    rig: Rig, captures: CaptureSet, T_root_sensor: Mapping[str, Array]
) -> tuple[Bundle, BundleState, list[int]]:
    """All views of some frames, without rejections, with start values; and the frames."""
    T_root_sensor = {name: T for name, T in T_root_sensor.items() if name == ROOT or captures.detections[name]}
    frames = sorted({frame for name in T_root_sensor for frame in captures.detections[name]})
    observed = [
        BoardObservation(frame, {name: 0 for name in T_root_sensor if frame in captures.detections[name]})
        for frame in frames
    ]
    observed = [one for one in observed if len(one.detection_index) > 1]
    return *build_bundle(rig, captures, observed, T_root_sensor), [one.capture for one in observed]


def locate_all(bundle: Bundle, state: BundleState) -> BundleState:
    """The state with the boards located by all cameras, whose poses are fixed."""
    return locate_boards(bundle, state, np.arange(len(state.T_root_board)), BOARD_STEPS)


def held_out_error(rig: Rig, captures: CaptureSet, T_root_sensor: Mapping[str, Array], fit: Fit | None) -> float:
    """RMS reprojection error, px, of all corners of some frames with the cameras of others.

    Args:
        rig: the rig.
        captures: the held-out frames.
        T_root_sensor: poses from other frames.
        fit: of the other frames, if its systematic parameters are to be applied.
    """
    bundle, state, _ = bundle_of_all(rig, captures, T_root_sensor)
    if fit is None:
        flat = [-one.stated if one.quantity == "thickness" else 0.0 for one in bundle.extra_parameters]
        state = replace(state, extra=np.array(flat))
    elif (solved := fit.joint.solved_bundle) is not None:
        state = apply_systematic(solved, bundle, state)
    state = locate_all(bundle, state)
    errors = []
    for s, name in enumerate(bundle.sensors):
        views: Any = bundle.views[s]
        T = relative_poses(state.T_root_sensor[s], state.T_root_board[views.board])
        residual = views.linearize(T, state.extra[bundle.extra_indices(s)]).residual
        errors.append(residual * views.noise_scale * rig.cameras()[name].noise.pixel)
    return float(np.sqrt(np.mean(np.sum(np.concatenate(errors) ** 2, axis=1))))


def show_deviations(
    title: str, poses: Mapping[str, Array], fit: Fit, covariance: Callable[[str], Array] | None = None
) -> None:
    """Prints how far poses lie from a fit, by camera."""
    for name, T in fit.joint.T_root_sensor.items():
        if name == ROOT:
            continue
        if name not in poses:
            print(f"{title:22} {name:9} lost")
            continue
        d = se3.difference(poses[name], T)
        P = covariance(name) if covariance else fit.calibration[name].covariance
        worst, mahalanobis = np.max(np.abs(d) / np.sqrt(np.diag(P))), np.sqrt(d @ np.linalg.solve(P, d) / 6)
        print(
            f"{title:22} {name:9} {1000 * np.linalg.norm(d[:3]):7.1f} mm {np.degrees(np.linalg.norm(d[3:])):6.2f}°"
            f" {worst:6.1f} {mahalanobis:6.1f}"
        )


def main() -> None:
    """Prints the tables."""
    parser = make_parser(__doc__)
    parser.add_argument("--unstamped", action="store_true", help="as if the frames of one index were of one time")
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)
    rig = read_rig()
    all_frames = read_frames(rig, stamps=not arguments.unstamped)
    frames = list(all_frames)
    every = fit_captures(rig, all_frames.captures())
    views = sum(len(found) for found in every.captures.detections.values())
    print(f"{len(frames)} frames, {views} views, {len(every.joint.rejected)} rejected by the joint solution")
    for sensor in every.calibration.sensors:
        stddev = np.sqrt(np.diag(sensor.covariance))
        print(
            f"{sensor.name}: {sensor.verdict.grade}, ±{1000 * stddev[:3].max():.1f} mm, "
            f"±{np.degrees(stddev[3:].max()):.2f}° {sensor.verdict.reason}"
        )
    for name, reason in every.calibration.evidence.unconnected.items():
        print(f"{name}: no pose: {reason}")
    print("".join(f"remark: {remark}\n" for remark in every.calibration.evidence.remarks), end="")
    print(f"{'':32} {'':10} {'':7} sigmas: worst axis, Mahalanobis")
    plain = fit_by_least_squares(rig, every.captures, every.joint.T_root_sensor)
    show_deviations("plain least squares", plain, every)
    show_deviations("published", published_poses(rig), every)
    halves = {
        "odd, even frames": (frames[::2], frames[1::2]),
        "first, second half": (frames[: len(frames) // 2], frames[len(frames) // 2 :]),
    }
    held_out = []
    for title, (one, two) in halves.items():
        a, b = (fit_captures(rig, all_frames.select(half).captures()) for half in (one, two))

        def covariance(name: str, a: Fit = a, b: Fit = b) -> Array:
            cross = cross_covariance(a.joint, b.joint, name)
            return np.asarray(a.calibration[name].covariance + b.calibration[name].covariance - cross - cross.T)

        show_deviations(title, a.joint.T_root_sensor, b, covariance)
        for half in (a, b):
            for name, reason in half.calibration.evidence.unconnected.items():
                print(f"{title:22} {name}: no pose: {reason}")
        for fitted, other in ((a, b), (b, a)):
            ls = fit_by_least_squares(rig, fitted.captures, fitted.joint.T_root_sensor)
            held_out.append(
                (
                    title,
                    held_out_error(rig, other.captures, fitted.joint.T_root_sensor, fitted),
                    held_out_error(rig, other.captures, ls, None),
                )
            )
    print("Held-out reprojection error, px: calgraph, plain least squares")
    for title, ours, theirs in held_out:
        print(f"{title:22} {ours:6.2f} {theirs:6.2f}")
    print(f"{time.process_time():.0f} s of CPU")


if __name__ == "__main__":
    main()
