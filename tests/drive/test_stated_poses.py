"""Poses that a file states for a robot that drives."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calgraph.config import Rig
from calgraph.drive.stated_poses import StatedPose, find_wrong_poses, resolve_stated_poses
from calgraph.errors import InputError
from calgraph.geometry import se3
from calgraph.io.text_writing import save_yaml
from calgraph.result import read_extrinsics
from calgraph.result.extrinsics_file import PriorFile

RIG = Rig.model_validate({
    "root": "front",
    "target": {"kind": "surroundings"},
    "sensors": {name: {"kind": "lidar3d", "topic": f"/{name}"} for name in ("front", "rear", "right")},
})  # fmt: skip


def stated(tmp_path: Path, stddev: tuple[float, float] = (0.01, 0.02), child: str = "rear_link") -> PriorFile:
    transform = {"translation": {"x": -1.0, "y": 0.2, "z": 0.5}, "rotation": {"x": 0, "y": 0, "z": 1, "w": 0}}
    row = {"frame_id": "front", "child_frame_id": child, "transform": transform}
    save_yaml(tmp_path / "poses.yaml", {"transforms": [row]})
    return PriorFile(read_extrinsics(tmp_path / "poses.yaml"), stddev)


def test_frames_of_messages_are_matched(tmp_path: Path) -> None:
    found = resolve_stated_poses(RIG, "front", {"rear": "rear_link"}, stated(tmp_path), 3)
    assert list(found) == ["rear"]
    assert_allclose(found["rear"].T[:3, 3], [-1, 0.2, 0.5])
    assert_allclose(np.diag(found["rear"].covariance), np.repeat([1e-4, 4e-4], 3))


def test_poses_are_against_the_sensor_that_leads(tmp_path: Path) -> None:
    found = resolve_stated_poses(RIG, "rear", {"rear": "rear_link"}, stated(tmp_path), 3)
    assert_allclose(found["front"].T[:3, 3], [-1, 0.2, -0.5], atol=1e-12)


def test_in_the_plane_height_roll_and_pitch_are_left_out(tmp_path: Path) -> None:
    found = resolve_stated_poses(RIG, "front", {"rear": "rear_link"}, stated(tmp_path), 2)["rear"]
    assert_allclose(found.T, np.array([[-1, 0, -1], [0, -1, 0.2], [0, 0, 1]]), atol=1e-12)
    assert_allclose(np.diag(found.covariance), [1e-4, 1e-4, 4e-4])


def test_exact_poses_and_unknown_frames_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="must be above 0 for a robot that drives"):
        resolve_stated_poses(RIG, "front", {}, stated(tmp_path, (0, 0)), 3)
    with pytest.raises(InputError, match="has no frame 'right'"):
        resolve_stated_poses(RIG, "right", {"rear": "rear_link"}, stated(tmp_path), 3)


@pytest.mark.parametrize(("metres", "wrong"), [(0.02, False), (0.08, True)])
@pytest.mark.parametrize("stddev", [0.001, 0.0099])
def test_a_stated_pose_that_the_drive_contradicts_is_named(metres: float, wrong: bool, stddev: float) -> None:
    """By its error against the posterior, of which the prior is a part; 0.01 m are stated."""
    prior = StatedPose(np.eye(4), 1e-4 * np.eye(6))
    # The drive alone has a standard deviation of d, and an error of metres: the solution is their mean.
    drive_variance = 1 / (stddev**-2 - 1e4)
    weight = stddev**2 / drive_variance
    T = se3.pose(np.eye(3), np.array([metres * weight, 0, 0]))
    P = [np.zeros((6, 6)), stddev**2 * np.eye(6)]
    found = find_wrong_poses({"rear": prior}, ["front", "rear"], [np.eye(4), T], P)
    # With 0.0099 m the drive determines nothing: 0.08 m are within its own error.
    assert bool(found) == (wrong and stddev < 0.005)
    if found:
        assert found[0].sensors == ("rear",)
        assert "the prior of rear disagrees with the drive by 8.0 standard deviations" in found[0].text
