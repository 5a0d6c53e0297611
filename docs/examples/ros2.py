"""
Reading the result in ROS 2
===========================

The tree of transforms as a launch file, as tf, and as URDF. No ROS is needed to write them, nor to run this page.
"""

# sphinx_gallery_thumbnail_path = 'images/example_rig.png'

# %%
# A result
# --------
# For your robot: ``calibration = calgraph.load_calibration("result/calibration.yaml")``.
from pathlib import Path
from tempfile import mkdtemp

import calgraph
from calgraph.simulation import CameraOptions, MultibeamOptions, RigScenario, SpinningOptions, simulate_rig

folder = Path(mkdtemp())
scenario = RigScenario(
    camera=CameraOptions(texels_per_mm=0.5), multibeam=MultibeamOptions(count=1),
    spinning=SpinningOptions(count=0), bearings=(-20, 0, 20), radii=(1.7, 2.5), samples=2,
)  # fmt: skip
simulate_rig(scenario, folder, seed=0)
with calgraph.open_recording(folder / "recording") as recording:
    calibration = calgraph.calibrate_rig(
        calgraph.load_rig(folder / "rig.yaml"), recording, calgraph.RigOptions(folds=0)
    )
print(calgraph.to_dataframe(calibration)[["frame_id", "parent", "x", "y", "z", "verdict"]].round(3).to_string())

# %%
# A launch file
# -------------
# One ``static_transform_publisher`` for each edge of the tree; ``calgraph export result/ --format launch``
# writes the same.
launch = folder / "sensors.launch.py"
launch.write_text(calgraph.export(calibration, "launch"))
print(launch.read_text()[:1100], "...")

# %%
# Where ROS 2 is installed, ``ros2 launch ./sensors.launch.py`` publishes it, and ``ros2 run tf2_ros tf2_echo
# lidar camera_optical`` prints ``T_lidar_camera``. From another launch file, include it:
#
# .. code-block:: python
#
#     IncludeLaunchDescription(PythonLaunchDescriptionSource("sensors.launch.py"))

# %%
# tf as data
# ----------
# The layout of ``tf2_msgs/TFMessage``, for programs that publish on ``/tf_static`` themselves. Read back with
# any YAML parser, each entry is ``T_parent_child``:
from ruamel.yaml import YAML

transforms = YAML(typ="safe").load(calgraph.export(calibration, "tf"))["transforms"]
for one in transforms:
    xyz = [one["transform"]["translation"][k] for k in "xyz"]
    xyzw = [one["transform"]["rotation"][k] for k in "xyzw"]
    T_parent_child = calgraph.se3.from_xyz_quaternion(xyz, xyzw)
    print(one["header"]["frame_id"], "→", one["child_frame_id"], T_parent_child[:3, 3].round(3))

# %%
# In a node, with rclpy:
#
# .. code-block:: python
#
#     message = TransformStamped()
#     rosidl_runtime_py.set_message_fields(message, one)
#     StaticTransformBroadcaster(node).sendTransform(message)

# %%
# URDF
# ----
# A new URDF; or, with ``urdf=text``, an existing one with the origins of the sensors' joints corrected.
print(calgraph.export(calibration, "urdf"))

# %%
# Any URDF, tf file or calibration.yaml can be compared with a later recording: ``calgraph check rig.yaml
# RECORDING --against robot.urdf`` states which sensor has moved.
