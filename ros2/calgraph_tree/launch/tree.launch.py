"""Static transforms of the calibrated sensors, from what ``calgraph export RESULT --format launch`` wrote.

``ros2 launch calgraph_tree tree.launch.py`` publishes ``launch/sensors.launch.py`` of this package, and with
``file:=/path/to/sensors.launch.py`` any other.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, ThisLaunchFileDir


def generate_launch_description():
    """Includes the launch file given."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "file",
                default_value=[ThisLaunchFileDir(), "/sensors.launch.py"],
                description="Launch file that calgraph exported",
            ),
            IncludeLaunchDescription(PythonLaunchDescriptionSource(LaunchConfiguration("file"))),
        ]
    )
