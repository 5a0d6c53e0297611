"""Bowed boards that no camera identified: their bow is told apart from errors of ranges and rings.

The ranges of a flat board determine the bias of ranges to millimetres, since a bias curves a plane. A bow curves
it as well: with boards that were taken for flat, poses were wrong by centimetres.
"""

import numpy as np
import pytest

from calgraph.config import Board, Checkerboard
from calgraph.geometry import se3
from calgraph.rig.bundle.range_observations import bow_shape, round_bow_shape
from calgraph.simulation import CameraOptions, LaserOptions, MultibeamOptions, RigScenario
from detected_rigs import QUICK, DetectedRig, detect_rig
from rig_errors import BoardErrors, ModelErrors

ONE_PLACE = QUICK.model_copy(
    update={
        "camera": CameraOptions(count=0),
        "laser": LaserOptions(count=0),
        "multibeam": MultibeamOptions(count=2, resolution=0.4),
        "bearings": (-6, -4, -2, 0, 2, 4, 6, 8),
        "radii": (1.2,),
    }
)
"""Two LiDARs before which a board is rotated: all rings see it at about the same height."""
SQUARE = ONE_PLACE.model_copy(
    update={
        "board": Board(size=(0.9, 0.9), pattern=Checkerboard(kind="checkerboard", columns=7, rows=6, square=0.1))
    }
)


def detect_bowed(scenario: RigScenario, seed: int, bow: tuple[float, float]) -> DetectedRig:
    return detect_rig(scenario, seed, ModelErrors(board=BoardErrors(bow=(*bow, 0.0))))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("bow", [(0.006, 0.0), (0.0, -0.006)])
def test_lidars_alone_recover_the_bow(seed: int, bow: tuple[float, float]) -> None:
    joint = detect_bowed(ONE_PLACE, seed, bow).solve()
    found = [one for one in joint.systematic if one.quantity.startswith("bow along")]
    assert [one.value for one in found] == pytest.approx(bow, abs=0.0008)
    assert max(one.stddev for one in found) < 0.0004


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("scenario", "bow"), [(ONE_PLACE, (0.006, 0.0)), (SQUARE, (0.004, 0.004))])
def test_a_bow_leaves_poses_within_their_standard_deviations(
    scenario: RigScenario, seed: int, bow: tuple[float, float]
) -> None:
    """Outlines do not tell the width of a square board from its height: its mean curvature is estimated."""
    one = detect_bowed(scenario, seed, bow)
    joint = one.solve()
    (name,) = set(one.T_root_sensor) - {one.rig.root}
    off = se3.difference(joint.T_root_sensor[name], one.T_root_sensor[name])
    assert np.all(np.abs(off) < 3 * np.sqrt(np.diag(joint.covariance[name])))


def test_the_bow_in_an_unknown_rotation_is_the_mean_of_all_rotations() -> None:
    half, points = np.array([[0.6, 0.4]]), np.array([[0.0, 0.0], [0.1, 0.2], [-0.3, 0.1], [0.05, -0.35]])
    angles = np.radians(np.arange(360))
    turns = np.moveaxis(np.array([[np.cos(angles), -np.sin(angles)], [np.sin(angles), np.cos(angles)]]), -1, 0)
    mean = np.mean([bow_shape(points @ turn.T, half) for turn in turns], axis=0)
    found = round_bow_shape(points, half)
    np.testing.assert_allclose(found - found[0], mean - mean[0], atol=1e-9)
