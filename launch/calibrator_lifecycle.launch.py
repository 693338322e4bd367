# SPDX-License-Identifier: Apache-2.0
"""ros2 launch dashcalib_ros calibrator_lifecycle.launch.py [namespace:=front] ...

The node waits for a lifecycle manager. With manage:=true this launch is one: it configures and
activates the node, also after it was started again. The other arguments are
calibrator.launch.py's.
"""
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

ONE = PathJoinSubstitution([FindPackageShare('dashcalib_ros'), 'launch', 'calibrator.launch.py'])


def generate_launch_description():
    """Start one node as a lifecycle node."""
    return LaunchDescription([
        DeclareLaunchArgument('manage', default_value='true', description='false: another program '
                              'changes the state of the node'),
        IncludeLaunchDescription(PythonLaunchDescriptionSource(ONE), launch_arguments={
            'autostart': 'false', 'manage': LaunchConfiguration('manage')}.items())])
