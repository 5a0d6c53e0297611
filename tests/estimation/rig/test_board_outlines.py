"""Boards are registered to their edges in scans; edges of boards of another size are not used."""

from dataclasses import replace

import numpy as np

from calgraph.config import Board
from calgraph.detection import BoardCorners, Detection
from calgraph.geometry import se3
from calgraph.simulation import CameraOptions, LaserOptions, MultibeamOptions
from detected_rigs import QUICK, detect_rig

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


def test_outlines_that_fit_cause_no_remark() -> None:
    assert detect_rig(FINE).solve().remarks == ()


def test_outlines_reduce_the_variance_of_every_axis() -> None:
    one = detect_rig(BLIND)
    blunt = one.map_detections(without_edges)
    with_edges, without = (np.diag(rig.solve().covariance["laser_front"]) for rig in (one, blunt))
    assert np.all(with_edges < without)
    assert np.sqrt(np.prod(with_edges / without)) < 0.5


def test_boards_of_a_wrong_size_are_remarked_and_their_outlines_not_used() -> None:
    one = detect_rig(FINE)
    blunt = one.map_detections(without_edges).solve()
    board = one.rig.boards[0]
    large = Board.model_validate({**board.model_dump(), "size": (board.size[0] + 0.08, board.size[1] + 0.08)})
    wrong = replace(one, rig=one.rig.model_copy(update={"target": large}))
    joint = wrong.solve()
    assert any(
        remark.startswith("board edges in scans of lidar are 40 mm inside the target's size on average")
        for remark in joint.remarks
    )
    # Sway is relative to the stated size, too: nothing else differs.
    for name in ("camera", "laser_front"):
        error = se3.difference(joint.T_root_sensor[name], blunt.T_root_sensor[name])
        assert np.all(np.abs(error) < 0.2 * np.sqrt(np.diag(blunt.covariance[name])))


def print_aside(_: str, detection: Detection) -> Detection:
    """As if the print were 3 cm to the left of its stated place on the board."""
    if not isinstance(detection, BoardCorners):
        return detection
    aside = np.array([0.03, 0.0, 0.0])
    T_aside = se3.pose(np.eye(3), -aside)
    return replace(
        detection, corners_board=detection.corners_board + aside, T_camera_board=detection.T_camera_board @ T_aside
    )


def test_outlines_that_contradict_the_print_are_not_used() -> None:
    one = detect_rig(FINE).map_detections(print_aside)
    blunt = one.map_detections(without_edges).solve()
    joint = one.solve()
    (remark,) = joint.remarks
    assert "contradict the fitted planes and tags" in remark
    np.testing.assert_allclose(joint.T_root_sensor["camera"], blunt.T_root_sensor["camera"], atol=1e-9)
