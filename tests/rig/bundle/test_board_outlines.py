"""Boards are registered to their edges in scans; edges of boards of another size are not used."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.boards.detections import BoardCorners, Detection
from calgraph.config import Board
from calgraph.geometry import se3
from calgraph.result import EstimatedParameter
from calgraph.rig.bundle.range_observations import RangeObservations
from calgraph.rig.bundle.solution import RigSolution
from calgraph.simulation import CameraOptions, LaserOptions, MultibeamOptions
from detected_rigs import QUICK, DetectedRig, detect_rig
from rig_errors import BoardErrors, ModelErrors

FINE = QUICK.model_copy(
    update={
        "laser": LaserOptions(count=1, resolution=0.5),
        "multibeam": MultibeamOptions(count=1, resolution=0.4),
        "radii": (1.5, 2.2),
    }
)
BLIND = FINE.model_copy(update={"camera": CameraOptions(count=0)})


def without_edges(_: str, detection: Detection) -> Detection:
    if isinstance(detection, BoardCorners):
        return detection
    return replace(detection, edges=np.empty((0, 2, 3)))


def test_without_cameras_boards_are_registered_by_their_outlines() -> None:
    one = detect_rig(BLIND)
    adjusted = one.solve().solved_bundle
    assert adjusted is not None
    boards = {i: board.T_root_board for i, board in enumerate(one.truth.boards)}
    T_truth = np.array([boards[int(capture)] for capture in adjusted.captures])
    off = se3.inverse(T_truth) @ adjusted.minimized.state.T_root_board
    centers, turns = np.linalg.norm(off[:, :2, 3], axis=1), np.abs(off[:, 0, 1])
    # A rectangle is ambiguous by half a turn; a few boards cannot be registered.
    assert np.mean((centers < 0.01) & (turns < 0.02)) > 0.8


def test_the_bow_acts_on_boards_that_only_their_outlines_locate() -> None:
    """Half of the boards are beside the camera's field of view."""
    scenario = FINE.model_copy(update={"bearings": (-80, -60, -20, 0, 20, 60, 80)})
    flat, bent = (
        detect_rig(scenario, errors=ModelErrors(board=BoardErrors(bow=(bow, 0.0, 0.0)))) for bow in (0.0, 0.004)
    )
    joint = bent.solve()
    assert joint.solved_bundle is not None
    bundle = joint.solved_bundle.bundle
    lidar, camera = (bundle.views[bundle.sensors.index(name)] for name in ("lidar", "camera"))
    assert isinstance(lidar, RangeObservations)
    assert len(camera.board) < 0.7 * len(lidar.board)
    assert lidar.registered.mean() > 0.9
    (bow,) = [one for one in joint.systematic if one.quantity == "bow along x"]
    assert bow.value == pytest.approx(0.004, abs=0.0004)
    moved = joint.T_root_sensor["camera"][:3, 3] - flat.solve().T_root_sensor["camera"][:3, 3]
    assert np.linalg.norm(moved) < 0.0015


def test_outlines_reduce_the_variance_of_every_axis() -> None:
    one = detect_rig(BLIND)
    blunt = one.map_detections(without_edges)
    with_edges, without = (np.diag(rig.solve().covariance["laser_front"]) for rig in (one, blunt))
    assert np.all(with_edges < without)
    # The bias of a view's edges is at least 8 mm.
    assert np.sqrt(np.prod(with_edges / without)) < 0.7


def test_a_wrong_size_of_the_board_is_attributed_to_footprints_and_poses_are_right() -> None:
    """Stated 8 cm too large: both sides are measured 4 cm too far inwards, at any distance."""
    one = detect_rig(FINE)
    board = one.rig.boards[0]
    large = Board.model_validate({**board.model_dump(), "size": (board.size[0] + 0.08, board.size[1] + 0.08)})
    wrong = replace(one, rig=one.rig.model_copy(update={"target": large}))
    joint = wrong.solve()
    for name in ("lidar", "laser_front"):
        (footprint,) = [e for e in joint.systematic if (e.of, e.quantity) == (name, "azimuth footprint")]
        assert footprint.deviation < -3
        assert footprint.value == pytest.approx(-0.04, abs=0.004)
    for name in ("camera", "laser_front"):
        assert wrong.mahalanobis(joint, name) < 3


def print_aside(one: DetectedRig, distance: float) -> DetectedRig:
    """As if the print were to the left of its stated place on the board."""
    aside = np.array([distance, 0.0, 0.0])

    def displace(_: str, detection: Detection) -> Detection:
        if not isinstance(detection, BoardCorners):
            return detection
        T_aside = se3.pose(np.eye(3), -aside)
        return replace(
            detection,
            corners_board=detection.corners_board + aside,
            T_camera_board=detection.T_camera_board @ T_aside,
        )

    return one.map_detections(displace)


def print_x(joint: RigSolution) -> EstimatedParameter:
    (found,) = [one for one in joint.systematic if one.quantity == "print x"]
    return found


def test_a_print_slightly_aside_does_not_matter() -> None:
    """By 6 mm, three prior standard deviations."""
    aside = print_aside(detect_rig(FINE), 0.006)
    joint = aside.solve()
    assert print_x(joint).value == pytest.approx(-0.006, abs=0.004)
    assert aside.mahalanobis(joint, "camera") < 3


def test_a_print_far_aside_is_beyond_its_prior() -> None:
    """By 3 cm: poses are compromises, which the parameter shows."""
    assert print_x(print_aside(detect_rig(FINE), 0.03).solve()).deviation < -3
