"""
Detections of another program
=============================

If your program already detects the board (corners in images, points in clouds, beams in scans), calgraph accepts
the arrays. No recording is needed.
"""

# sphinx_gallery_thumbnail_path = 'images/recording_places.svg'

# %%
# The rig
# -------
# Kinds, noise and intrinsics; topics are not used here.
import numpy as np

import calgraph

rig = calgraph.Rig(
    root="lidar",
    target=calgraph.Board(
        size=(1.0, 0.8),
        tags=(
            calgraph.Tag(id=0, size=0.3, center=(-0.3, 0.2)),
            calgraph.Tag(id=1, size=0.3, center=(0.3, 0.2)),
            calgraph.Tag(id=2, size=0.3, center=(0.0, -0.2)),
        ),
    ),
    sensors={
        "lidar": calgraph.Lidar3dSpec(topic="lidar", noise=calgraph.RangeNoise(range=0.02)),
        "laser": calgraph.Lidar2dSpec(topic="laser", noise=calgraph.RangeNoise(range=0.01)),
        "camera": calgraph.CameraSpec(
            topic="camera",
            noise=calgraph.PixelNoise(pixel=0.3),
            intrinsics=calgraph.Intrinsics(width=1280, height=960, K=(800.0, 800.0, 640.0, 480.0)),
        ),
    },
)

# %%
# Simulated detections
# --------------------
# A board at some pose, and the measurements of each sensor. With real data, the arrays are the same:
# corners in the board's frame with their pixels, and points in the sensor's frame. Leave out points nearer to the
# outline than three times the noise: which of them remain depends on their errors, and turns the plane.
from calgraph import se3, so3

rng = np.random.default_rng(1)
TRUE = {
    "lidar": np.eye(4),
    "laser": se3.from_xyz_quaternion(np.array([0.6, 0.1, -0.3]), np.array([0.03, 0.05, 0.0, 1.0])),
    "camera": se3.from_xyz_quaternion(np.array([0.4, 0.1, -0.1]), np.array([-0.5, 0.49, -0.5, 0.51])),
}
camera = rig.camera_models()["camera"]
tags = np.array([tag.center for tag in rig.target.tags])
corners = np.array([[x + u, y + v, 0.0] for x, y in tags for u in (-0.15, 0.15) for v in (-0.15, 0.15)])


# The board's x, y and z axes in the LiDAR's frame when it faces the robot: right is -y, up is z, out is -x.
FACING = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def board_poses(count):
    """Two metres ahead, left and right, high and low, and tilted to all sides: ``T_lidar_board``."""
    for _ in range(count):
        place = np.array([rng.uniform(1.8, 2.8), rng.uniform(-0.8, 0.8), rng.uniform(-0.4, 0.1)])
        yield se3.pose(so3.exp(rng.uniform(-0.6, 0.6, 3)) @ FACING, place)


def beams_on_board(T_sensor_board, directions, sigma):
    """Where beams end on the board, with noise along them; those off it, or on its outline, are left out."""
    n, d = np.split(calgraph.plane.from_pose(T_sensor_board), [3])
    ranges = -d / (directions @ n)
    x, y, _ = se3.apply(se3.inverse(T_sensor_board), directions * ranges[:, None]).T
    hit = (ranges > 0) & (abs(x) < 0.48) & (abs(y) < 0.38)
    return directions[hit] * (ranges[hit] + rng.normal(0, sigma, hit.sum()))[:, None]


def rays(azimuth, elevation):
    """Unit directions of all pairs of angles, rad."""
    a, e = (angles.ravel() for angles in np.meshgrid(azimuth, elevation))
    return np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


LIDAR = rays(np.radians(np.arange(-60, 60, 0.4)), np.radians(np.arange(-15, 16, 2)))
LASER = rays(np.radians(np.arange(-90, 90, 0.25)), np.zeros(1))

# %%
# Detections by sensor and capture
# --------------------------------
# One line for each sensor. The functions fit plane, line and pose with their covariances, reject outliers,
# and return :class:`calgraph.Rejected` with the reason where too few measurements remain. All
# detections under one number are of the same board at rest; sensors without a detection are left out.
found = {name: {} for name in rig.sensors}
for capture, T_lidar_board in enumerate(board_poses(60)):
    T = {name: se3.inverse(TRUE[name]) @ T_lidar_board for name in TRUE}
    cloud, scan = beams_on_board(T["lidar"], LIDAR, 0.02), beams_on_board(T["laser"], LASER, 0.01)
    pixels = camera.project(se3.apply(T["camera"], corners)) + rng.normal(0, 0.3, (len(corners), 2))
    found["lidar"][capture] = calgraph.plane_patch_from_points(cloud, rig.sensors["lidar"].noise)
    found["laser"][capture] = calgraph.segment_from_points(scan, rig.sensors["laser"].noise)
    found["camera"][capture] = calgraph.board_corners_from_pixels(
        corners, pixels, camera, rig.sensors["camera"].noise
    )

for name, own in found.items():
    reasons = [f"{k}: {seen.reason}" for k, seen in own.items() if isinstance(seen, calgraph.Rejected)]
    print(f"{name}: {len(own) - len(reasons)} detections", *reasons[:1], sep="; ")

# %%
# Calibrating
# -----------
calibration = calgraph.calibrate_detections(rig, found)
for sensor in calibration.sensors:
    error = se3.difference(sensor.T_root_sensor, TRUE[sensor.name])
    stddev = np.sqrt(np.diag(sensor.covariance))
    print(f"{sensor.name:7} {sensor.verdict.grade}: off by {1000 * np.linalg.norm(error[:3]):.1f} mm, "
          f"{np.degrees(np.linalg.norm(error[3:])):.3f}°, at σ = {1000 * stddev[:3].max():.1f} mm")  # fmt: skip

# %%
# Relative poses of pairs
# -----------------------
# If you already have relative poses of *pairs*, with outliers, and need one pose for each sensor, average the
# graph. Here are all pairs of five sensors, of which a third are wrong; consensus over spanning trees
# identifies these.
from itertools import combinations

T_root_node = np.stack([se3.pose(so3.exp(rng.normal(0, 1, 3)), rng.normal(0, 2, 3)) for _ in range(5)])
T_root_node[0] = np.eye(4)
edges = np.array(list(combinations(range(5), 2)))
T_i_j = np.stack([se3.inverse(T_root_node[i]) @ T_root_node[j] for i, j in edges])
T_i_j = se3.retract(T_i_j, rng.normal(0, 0.002, (10, 6)))
T_i_j[[1, 5, 8]] = se3.retract(T_i_j[[1, 5, 8]], rng.normal(0, 1, (3, 6)))

graph = calgraph.PoseGraph(5, edges, T_i_j, np.tile(np.eye(6) / 0.002**2, (10, 1, 1)))
averaged = calgraph.average_poses(graph, np.random.default_rng(0))
print("wrong edges:", edges[~averaged.inliers].tolist())
print(f"largest error: {1000 * abs(averaged.T_root_node - T_root_node)[:, :3, 3].max():.1f} mm")
