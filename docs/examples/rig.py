"""
A rig, from a recording to its poses
====================================

Simulates the recording of a robot with a camera, a 2-D scanner and a LiDAR, calibrates it and reads the result.
"""

# sphinx_gallery_thumbnail_path = 'images/example_rig.png'

# %%
# A recording
# -----------
# With a real recording, begin below: ``rig.yaml`` describes the sensors and the board, and
# :func:`calgraph.open_recording` reads the recording. The board is held in 14 places here; record
# more.
from pathlib import Path
from tempfile import mkdtemp

from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    simulate_rig,
)

folder = Path(mkdtemp())
scenario = RigScenario(
    camera=CameraOptions(width=640, height=480, texels_per_mm=0.5),
    laser=LaserOptions(count=1, rate=10, resolution=0.5),
    multibeam=MultibeamOptions(count=1, rate=5, resolution=0.5),
    spinning=SpinningOptions(count=0),
    bearings=(-30, -20, -10, 0, 10, 20, 30),
    samples=1,
    background=1.0,
)
simulate_rig(scenario, folder, seed=0)

# %%
# Calibrating
# -----------
# The same as ``calgraph calibrate rig.yaml recording -o result/``.
import calgraph

rig = calgraph.load_rig(folder / "rig.yaml")
with calgraph.open_recording(folder / "recording") as recording:
    calibration = calgraph.calibrate_rig(rig, recording)

calgraph.save_calibration(calibration, folder / "calibration.yaml")

# %%
# Reading the result
# ------------------
# One row per sensor: pose in the root's frame in metres and degrees, standard deviations, and the verdict.
table = calgraph.to_dataframe(calibration)
print(table[["x", "y", "z", "roll_deg", "pitch_deg", "yaw_deg", "verdict"]].round(4).to_string())

# %%
# Any two sensors: ``T_camera_laser`` maps coordinates of the scanner to those of the camera. Its covariance
# is of the error along and about the camera's axes, and includes the correlation of both errors.
import numpy as np

T_camera_laser = calibration.transform("camera", "laser_front")
stddev = np.sqrt(np.diag(calibration.covariance("camera", "laser_front")))
print(T_camera_laser.round(4))
print("σ, mm:", (1000 * stddev[:3]).round(2), " σ, degrees:", np.degrees(stddev[3:]).round(3))

# %%
# Cross-validation: errors on held-out captures, predicted by the other sensors. The ratio of observed to
# expected errors is about 1 if the standard deviations are consistent.
for name, left_out in calibration.evidence.cross_validation.items():
    print(f"{name:12} {left_out.captures} captures, ratio {left_out.ratio:.2f}")

# %%
# Errors against the ground truth of the simulation:
from calgraph.simulation import load_truth

truth = load_truth(folder / "truth.yaml")
for sensor in calibration.sensors:
    error = calgraph.se3.difference(sensor.T_root_sensor, truth.T_root_sensor[sensor.name])
    millimetres, degrees = 1000 * np.linalg.norm(error[:3]), np.degrees(np.linalg.norm(error[3:]))
    print(f"{sensor.name:12} {millimetres:.2f} mm, {degrees:.3f}°")

# %%
# Boards of all captures, and the sensors' axes (red, green, blue: x, y, z), in the root's frame:
import plotly.graph_objects as go

figure = go.Figure()
for outline in calibration.pictures.board_outlines:
    x, y, z = outline.corners[[0, 1, 2, 3, 0]].T
    figure.add_scatter3d(x=x, y=y, z=z, mode="lines", line={"color": "#999"}, showlegend=False)
for sensor in calibration.sensors:
    for axis, color in enumerate(("red", "green", "blue")):
        ends = calgraph.se3.apply(sensor.T_root_sensor, 0.25 * np.eye(4, 3, -1)[[0, axis + 1]])
        x, y, z = ends.T
        line = {"color": color, "width": 6}
        figure.add_scatter3d(x=x, y=y, z=z, mode="lines", line=line, name=sensor.name, showlegend=False)
figure.update_layout(scene={"aspectmode": "data"}, margin={"l": 0, "r": 0, "t": 0, "b": 0}, height=420)
figure
