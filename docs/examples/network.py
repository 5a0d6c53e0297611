"""
A network of scanners, from people walking through
==================================================

Five 2-D scanners in an L-shaped lab, with 20 s of scans as arrays instead of a recording.
"""

# sphinx_gallery_thumbnail_path = 'images/example_network.png'

# %%
# Scans
# -----
# By scanner, a list of :class:`calgraph.LaserScan`: angles, ranges, and the time of the first beam. These are
# simulated.
from calgraph.simulation import NetworkScenario, simulate_network_scans

scans, truth = simulate_network_scans(NetworkScenario(layout="lab", duration=20.0), seed=1)
print({name: f"{len(found)} scans of {len(found[0].ranges)} beams" for name, found in scans.items()})

# %%
# The network
# -----------
# The content of ``rig.yaml``, as an object. Messages by topic replace a recording.
import calgraph

rig = calgraph.Rig(
    root="scanner_1", target=calgraph.People(), sensors={name: calgraph.Lidar2dSpec(topic=name) for name in scans}
)
calibration = calgraph.calibrate_network(rig, calgraph.MessageRecording(scans))
columns = ["x", "y", "yaw_deg", "stddev_x", "stddev_y", "clock_offset", "verdict"]
print(calgraph.to_dataframe(calibration)[columns].round(4).to_string())

# %%
# Errors, mm and degrees:
import numpy as np

for sensor in calibration.sensors:
    error = calgraph.se3.difference(sensor.T_root_sensor, truth.T_root_sensor[sensor.name])
    print(f"{sensor.name}  {1000 * np.linalg.norm(error[:2]):.2f} mm, {np.degrees(abs(error[5])):.3f}°")

# %%
# The floor plan
# --------------
# Measurements of all scanners in one frame: the static background, and the tracks of people.
import plotly.graph_objects as go

figure = go.Figure()
for view in calibration.pictures.floor_views:
    x, y = view.background.T
    figure.add_scattergl(x=x, y=y, mode="markers", marker={"size": 3}, name=view.sensor, legendgroup=view.sensor)
    for walk in view.tracks:
        x, y = walk.T
        figure.add_scattergl(x=x, y=y, mode="lines", line={"color": "#bbb", "width": 1}, showlegend=False)
for sensor in calibration.sensors:
    x, y = sensor.T_root_sensor[:2, 3]
    figure.add_scatter(x=[x], y=[y], text=[sensor.name], mode="markers+text", textposition="top center",
                       marker={"color": "black", "symbol": "x"}, showlegend=False)  # fmt: skip
figure.update_yaxes(scaleanchor="x")
figure.update_layout(margin={"l": 0, "r": 0, "t": 20, "b": 0}, height=480, xaxis_title="x, m", yaxis_title="y, m")
figure
