"""Odometry of 3-D LiDARs against KISS-ICP (Vizzo et al. 2023), on the same sweeps."""

import numpy as np
import pytest

from calgraph.drive.odometry import track_sensor
from calgraph.geometry import se_n
from drive_scenes import beams_in_space, drive, scan

kiss_icp = pytest.importorskip("kiss_icp.kiss_icp", reason="kiss-icp is not installed")
config = pytest.importorskip("kiss_icp.config", reason="kiss-icp is not installed")


@pytest.mark.parametrize("seed", range(3))
def test_a_way_through_a_room_is_as_right_as_that_of_kiss_icp(seed: int) -> None:
    """Of sweeps that take no time, as both correct these for motion in other ways."""
    directions, _ = beams_in_space(32, 1.0)
    beams = directions, np.zeros(len(directions))
    sweeps = scan(beams, np.eye(4), 20.0, 0.01, np.random.default_rng(seed))
    track = track_sensor(sweeps, 600, np.random.default_rng(seed))
    settings = config.KISSConfig()
    settings.data.deskew = False
    settings.data.min_range = 0.1
    settings.data.max_range = 20.0
    settings.mapping.voxel_size = 0.2
    odometry = kiss_icp.KissICP(settings)
    poses = []
    for sweep in sweeps:
        odometry.register_frame(sweep.points, np.zeros(len(sweep.points)))
        poses.append(odometry.last_pose)
    T = drive(track.times, 3)
    expected = se_n.inverse(T[0]) @ T
    own, other = (
        float(np.sqrt(np.mean(np.sum(se_n.difference(one, expected)[:, :3] ** 2, axis=1))))
        for one in (track.poses, np.array(poses))
    )
    assert own < 1.2 * other + 0.005
