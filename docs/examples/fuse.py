"""
Fusing a cloud: points in the colours of the camera
===================================================

With calibrated poses, every point of a cloud is projected into the camera's image and takes its colour.
"""

# sphinx_gallery_thumbnail_path = 'images/example_fuse.png'

# %%
# A calibrated rig, and an image and a cloud
# ------------------------------------------
# For your robot: ``calgraph.load_calibration`` for the poses; the rest is the same with your recording and topics.
from pathlib import Path
from tempfile import mkdtemp

import numpy as np

import calgraph
from calgraph.simulation import (
    CameraOptions, LaserOptions, MultibeamOptions, RigScenario, SpinningOptions, simulate_rig,
)  # fmt: skip

folder = Path(mkdtemp())
scenario = RigScenario(
    camera=CameraOptions(width=960, height=720, texels_per_mm=1.0),
    multibeam=MultibeamOptions(count=1, rings=32, lowest=-20, highest=12, rate=5),
    laser=LaserOptions(count=0),
    spinning=SpinningOptions(count=0),
    bearings=(-20, 0, 20),
    samples=3,
)
simulate_rig(scenario, folder, seed=4)
rig = calgraph.load_rig(folder / "rig.yaml")
with calgraph.open_recording(folder / "recording") as recording:
    calibration = calgraph.calibrate_rig(rig, recording, calgraph.RigOptions(folds=0))
    # The board is at rest in the seconds of a capture.
    row = next(row for row in calibration.evidence.captures if row.used)
    window = (recording.start + row.start, recording.start + row.end)
    newest = {one.topic: one.decode() for one in recording.records(None, *window)}

image, cloud = (newest[rig.sensors[name].topic] for name in ("camera", "lidar"))
camera = newest["/camera/camera_info"].camera
print(f"{image.pixels.shape} pixels, {len(cloud.points)} points")

# %%
# Colours
# -------
# Points are transformed to the camera's frame, and :func:`calgraph.colorize_points` returns their colours. Points
# outside the image, and those that a nearer surface occludes, have none.
points_camera = calgraph.se3.apply(calibration.transform("camera", "lidar"), cloud.points)
colors, colored = calgraph.colorize_points(points_camera, camera, image.pixels)
print(f"{colored.sum()} of {len(colored)} points have a colour")

# %%
# The tags coincide with the board: an error of the rotation of half a degree would displace them by 2 to 5 cm at
# 2 to 6 m.
import plotly.graph_objects as go

near = colored & (np.linalg.norm(cloud.points, axis=1) < 6)
x, y, z = cloud.points[near].T
marker = {"size": 2, "color": [f"rgb({b},{b},{b})" for b in colors[near, 0]]}
figure = go.Figure(go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker))
figure.update_layout(
    scene={"aspectmode": "data", "camera": {"eye": {"x": -1.2, "y": 0.1, "z": 0.5}}},
    margin={"l": 0, "r": 0, "t": 0, "b": 0}, height=460,
)  # fmt: skip
figure
