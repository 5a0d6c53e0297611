"""
Two LiDARs that share no view, from a drive
===========================================

A robot with a LiDAR in front and one behind drives for half a minute; no board is needed.
"""

# sphinx_gallery_thumbnail_path = 'images/report_drive.png'

# %%
# A drive
# -------
# By topic, a list of :class:`calgraph.PointCloud` with the times of its points. These are simulated: in curves to
# both sides, and over ramps.
import calgraph
from calgraph.simulation import DriveScenario, simulate_drive

drive = simulate_drive(DriveScenario(seed=7, duration=30.0))
print({topic: f"{len(clouds)} clouds" for topic, clouds in drive.messages.items()})

# %%
# The rig
# -------
# The content of ``rig.yaml``, as an object.
sensors = {name: calgraph.Lidar3dSpec(topic=topic) for name, topic in drive.topics.items()}
rig = calgraph.Rig(root=drive.root, target=calgraph.Surroundings(), sensors=sensors)
calibration = calgraph.calibrate_drive(rig, drive.recording)
columns = ["x", "y", "z", "yaw_deg", "stddev_x", "stddev_y", "clock_offset", "verdict"]
print(calgraph.to_dataframe(calibration)[columns].round(4).to_string())

# %%
# Errors, mm and degrees:
import numpy as np

for sensor in calibration.sensors:
    error = calgraph.se3.difference(sensor.T_root_sensor, drive.truth.T_root_sensor[sensor.name])
    turn = np.degrees(np.linalg.norm(error[3:]))
    print(f"{sensor.name}  {1000 * np.linalg.norm(error[:3]):.1f} mm, {turn:.3f}°")

# %%
# The map
# -------
# Points of both LiDARs on walls and floors, from above, and the trajectory.
import plotly.graph_objects as go

figure = go.Figure()
for view in calibration.pictures.drive_views:
    path = calibration.pictures.drive_paths[view.part]
    T = path.T_world_root[np.searchsorted(path.times, view.times).clip(max=len(path.times) - 1)]
    points = calgraph.se3.apply(calibration[view.sensor].T_root_sensor, view.points)
    x, y = (np.einsum("nij,nj->ni", T[:, :2, :3], points) + T[:, :2, 3]).T
    figure.add_scattergl(x=x, y=y, mode="markers", marker={"size": 3}, name=view.sensor)
for path in calibration.pictures.drive_paths:
    x, y = path.T_world_root[:, :2, 3].T
    figure.add_scattergl(x=x, y=y, mode="lines", line={"color": "black"}, name="trajectory")
figure.update_yaxes(scaleanchor="x")
figure.update_layout(margin={"l": 0, "r": 0, "t": 20, "b": 0}, height=480, xaxis_title="x, m", yaxis_title="y, m")
figure
