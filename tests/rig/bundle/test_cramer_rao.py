"""The Cramér–Rao bound against one computed apart from it: by numerical derivatives, and with dense matrices."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest

from calgraph.boards.detections import BoardCorners
from calgraph.config import CameraSpec, Rig
from calgraph.geometry import Array, se3
from calgraph.rig.captures.detect import CaptureSet
from calgraph.simulation import CameraOptions, RigScenario, build_world
from detected_rigs import exact_rig
from efficiency import solve_at_truth
from ideal_detections import simulate_detections

STEP = 1e-5
"""Of numerical derivatives, m and rad."""


def numerical_bound(
    rig: Rig, captured: CaptureSet, T_root_sensor: Mapping[str, Array], T_root_board: Mapping[int, Array]
) -> dict[str, Array]:
    names = [name for name in T_root_sensor if name != rig.root]
    H = np.zeros((6 * len(names), 6 * len(names)))
    for capture, T_board in T_root_board.items():
        H_board, coupling = np.zeros((6, 6)), np.zeros((6, 6 * len(names)))
        for name, T_sensor in T_root_sensor.items():
            if capture not in captured.detections[name]:
                continue
            measured = measurements(rig, captured, name, capture)
            by_sensor, by_board = derivatives(measured, T_sensor, T_board)
            H_board += by_board.T @ by_board
            if name != rig.root:
                columns = slice(6 * names.index(name), 6 * names.index(name) + 6)
                H[columns, columns] += by_sensor.T @ by_sensor
                coupling[:, columns] += by_board.T @ by_sensor
        # Of a board without corners only the plane is measured: three directions are not observable.
        H -= coupling.T @ np.linalg.pinv(H_board, rcond=1e-9, hermitian=True) @ coupling
    covariance: Array = np.asarray(np.linalg.inv(H), dtype=np.float64)
    return {name: covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i, name in enumerate(names)}


def measurements(rig: Rig, captured: CaptureSet, name: str, capture: int) -> Callable[[Array], Array]:
    """From poses ``T_sensor_board`` (K, 4, 4) to measurements (K, N) in standard deviations."""
    spec, (detection,) = rig.sensors[name], captured.detections[name][capture]
    if isinstance(spec, CameraSpec):
        assert isinstance(detection, BoardCorners)
        corners, camera, pixel = detection.corners_board, captured.cameras[name], spec.noise.pixel
        return lambda T: np.array([camera.project(p).ravel() for p in se3.apply(T, corners)]) / pixel
    assert not isinstance(detection, BoardCorners)
    directions = detection.directions
    sigma = spec.noise.range
    return lambda T: (
        np.array([n @ t / (directions @ n) for n, t in zip(T[:, :3, 2], T[:, :3, 3], strict=True)]) / sigma
    )


def derivatives(
    measured: Callable[[Array], Array], T_root_sensor: Array, T_root_board: Array
) -> tuple[Array, Array]:
    """(N, 6) each, by perturbations of the sensor and of the board along the root's axes."""

    def central(ahead: Array, behind: Array) -> Array:
        return np.asarray((measured(ahead) - measured(behind)).T / (2 * STEP))

    steps, T_sensor_root = STEP * np.eye(6), se3.inverse(T_root_sensor)
    sensors = (se3.inverse(se3.retract(T_root_sensor, sign * steps)) @ T_root_board for sign in (1, -1))
    boards = (T_sensor_root @ se3.retract(T_root_board, sign * steps) for sign in (1, -1))
    return central(*sensors), central(*boards)


def without_edges(captured: CaptureSet) -> CaptureSet:
    """Planes and prints, without the outlines, as in the numerical bound above."""
    blunt = {
        name: {
            capture: tuple(d if isinstance(d, BoardCorners) else replace(d, edges=d.edges[:0]) for d in found)
            for capture, found in by_capture.items()
        }
        for name, by_capture in captured.detections.items()
    }
    return replace(captured, detections=blunt)


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_bound_is_that_of_numerical_derivatives(model: str) -> None:
    camera = CameraOptions.model_validate({"model": model, "width": 640, "height": 480, "texels_per_mm": 0.5})
    stage = build_world(RigScenario(camera=camera, samples=1), 3, images=False)
    rig, captured, truth = simulate_detections(stage, 0)
    rig, captured = exact_rig(rig), without_edges(captured)
    T_root_sensor = {rig.root: np.eye(4), **truth.T_root_sensor}
    T_root_board = {i: board.T_root_board for i, board in enumerate(truth.boards)}
    bound, _ = solve_at_truth(rig, captured, T_root_sensor, T_root_board)
    for name, expected in numerical_bound(rig, captured, T_root_sensor, T_root_board).items():
        # The estimator's robust weights withhold a few thousandths of the information of Gaussian noise.
        relative = np.linalg.eigvals(np.linalg.solve(expected, bound[name])).real
        np.testing.assert_allclose(relative, 1.0, atol=0.03)
