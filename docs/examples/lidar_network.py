"""
LiDARs and a 2-D scanner of a hall, from people walking through
===============================================================

Two 3-D LiDARs below the ceiling of a hall, and a scanner 0.9 m over its floor; 20 s are simulated.
"""

# sphinx_gallery_thumbnail_path = 'images/example_network.png'

# %%
# The network
# -----------
# As in ``rig.yaml``; ``root`` could be ``floor``, too. Neither people nor walls show the height of the scanner.
import calgraph
from calgraph.simulation import HallScenario, simulate_hall

hall = simulate_hall(HallScenario(seed=5, duration=20.0, lidars=("vlp16", "vlp16"), scanners=(0.9,)))
sensors = {
    "lidar_1": calgraph.Lidar3dSpec(topic="/lidar_1/points"),
    "lidar_2": calgraph.Lidar3dSpec(topic="/lidar_2/points"),
    "scanner_1": calgraph.Lidar2dSpec(topic="/scanner_1/scan", height=0.9),
}
rig = calgraph.Rig(root="lidar_1", target=calgraph.People(), sensors=sensors)

# %%
# Poses
# -----
# In place of ``hall.recording`` there may be a :class:`calgraph.MessageRecording`, or that of
# :func:`calgraph.open_recording`.
calibration = calgraph.calibrate_network(rig, hall.recording)
calibration

# %%
# A reason states what to measure where a pose is weak:
print(calibration["lidar_2"].verdict.reason)

# %%
# Errors of positions, mm:
for sensor in calibration.sensors[1:]:
    error = calgraph.se3.difference(sensor.T_root_sensor, hall.truth.T_root_sensor[sensor.name])
    print(sensor.name, (1000 * error[:3]).round(1))
